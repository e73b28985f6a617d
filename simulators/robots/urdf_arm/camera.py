"""Camera beside an arm, which measures the place of the tool tip."""

from collections.abc import Mapping

import numpy as np

from simulators.faults import UnknownPart
from simulators.robots.urdf_arm.body import TIP, Body

FAULTS = ("camera_covered", "camera_back")


class TipCamera:
    """Sees the tool tip unless it is covered; not thread-safe."""

    def __init__(self, reach: float, body: Body, seed: int) -> None:
        """Make the camera of one variant; the seed chooses its noise, which grows with the reach [m]."""
        self._shift, self._noise = reach * body.camera_shift, reach * body.camera_noise
        self._random = np.random.default_rng([seed, 11])
        self._is_covered = False

    def see(self, truth: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the tool tip as the camera reports it [m], shape (3,); NaN if it is covered.

        Args:
            truth: Signal -> true value; only the tool tip is used.
        """
        if self._is_covered:
            return {TIP: np.full(3, np.nan)}
        return {TIP: truth[TIP] + self._shift + self._noise * self._random.standard_normal(3)}

    def fault(self, text: str) -> str:
        """Apply `camera_covered` or `camera_back`; return a sentence on it.

        Raises:
            UnknownPart: The fault is another one.
        """
        if text not in FAULTS:
            raise UnknownPart(f"'{text}' is no fault of the camera. Known faults: {', '.join(FAULTS)}.")
        self._is_covered = text == FAULTS[0]
        return "The camera is covered." if self._is_covered else "The camera sees again."
