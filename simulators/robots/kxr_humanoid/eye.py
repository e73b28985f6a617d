"""The camera on the head: a marker on the tool's tip gives its position, the tip's colour its place in the image."""

from collections.abc import Mapping

import numpy as np

from simulators.faults import UnknownPart
from simulators.robots.kxr_humanoid.body import Body
from simulators.robots.kxr_humanoid.statics import is_in_view

POSITION, PIXEL = "tool_tip_position", "tool_tip_pixel"

_FAULTS: Mapping[str, tuple[str, bool, str]] = {
    "marker_removed": ("_has_marker", False, "The marker is off the tool; its tip is still seen by its colour."),
    "marker_back": ("_has_marker", True, "The marker is on the tool again."),
    "camera_covered": ("_is_open", False, "The camera is covered."),
    "camera_back": ("_is_open", True, "The camera sees again."),
}


class Eye:
    """Camera that measures the scene; not thread-safe.

    The position is in the frame of the feet: a second marker, on the ground, gives the pose of the camera.
    """

    def __init__(self, body: Body, random: np.random.Generator) -> None:
        self._camera = body.camera
        self._noise = body.noise
        self._random = random
        self._has_marker = self._is_open = True

    def see(self, truth: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return both signals [m, px], shapes (3,), (2,); NaN if the tip is out of sight or a marker is missing.

        Args:
            truth: Signal -> true value; the image point may be beyond the image.
        """
        seen = {name: np.full(len(truth[name]), np.nan) for name in (POSITION, PIXEL)}
        if not self._is_open or not is_in_view(self._camera, truth[PIXEL][None])[0]:
            return seen
        for name in (POSITION, PIXEL) if self._has_marker else (PIXEL,):
            deviation = self._noise.get(name, 0.0)
            noise = deviation * self._random.standard_normal(len(truth[name])) if deviation else 0.0
            seen[name] = truth[name] + noise
        return seen

    def fault(self, text: str) -> str:
        """Apply `marker_removed`, `marker_back`, `camera_covered` or `camera_back`; return a sentence on it.

        Raises:
            UnknownPart: The fault is another one.
        """
        if text not in _FAULTS:
            raise UnknownPart(f"'{text}' is no fault of the camera. Known faults: {', '.join(_FAULTS)}.")
        name, value, sentence = _FAULTS[text]
        setattr(self, name, value)
        return sentence
