"""Depth camera on the head, which follows the duster's cloth and measures its centre."""

import math
from collections.abc import Mapping

import numpy as np

from simulators.faults import UnknownPart
from simulators.robots.pr2_duster.body import Body

SIGNAL = "tool_tip_position"
PLACE = np.array([-0.02, 0.0, 1.31])
"""The camera is at this place [m] in the base's frame."""
NEAREST, FARTHEST = 0.4, 4.0
"""Depth is measured between these distances [m]."""
PAN = 2.8
"""The head turns at most this far to either side [rad]."""
TILT_LOW, TILT_HIGH = -1.77, 0.84
"""The head's tilt and half the height of the picture reach these elevations [rad]."""
FAULTS = ("camera_covered", "camera_back")


class DepthCamera:
    """Sees the tool tip where the head can turn to it; not thread-safe."""

    def __init__(self, body: Body, seed: int) -> None:
        """Make a camera of one variant; the seed chooses its noise."""
        self._body = body
        self._random = np.random.default_rng([seed, 11])
        self._is_covered = False

    def see(self, truth: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the tool tip as the camera reports it [m], shape (3,); NaN if it is covered or out of sight.

        Args:
            truth: Signal -> true value; only the tool tip is used.
        """
        tip = truth[SIGNAL]
        if self._is_covered or not in_sight(tip):
            return {SIGNAL: np.full(3, np.nan)}
        body = self._body
        seen = body.camera_turn @ tip + body.camera_shift
        if body.camera_noise:
            seen = seen + body.camera_noise * self._random.standard_normal(3)
        return {SIGNAL: seen}

    def fault(self, text: str) -> str:
        """Apply `camera_covered` or `camera_back`; return a sentence on it.

        Raises:
            UnknownPart: The fault is another one.
        """
        if text not in FAULTS:
            raise UnknownPart(f"'{text}' is no fault of the camera. Known faults: {', '.join(FAULTS)}.")
        self._is_covered = text == FAULTS[0]
        return "The camera is covered." if self._is_covered else "The camera sees again."


def in_sight(tip: np.ndarray) -> bool:
    """Whether the head can turn to a point [m] in the base's frame, and the camera measures its distance."""
    x, y, z = (tip - PLACE).tolist()
    flat = math.hypot(x, y)
    is_near = NEAREST <= math.hypot(flat, z) <= FARTHEST
    return is_near and abs(math.atan2(y, x)) <= PAN and TILT_LOW <= math.atan2(z, flat) <= TILT_HIGH
