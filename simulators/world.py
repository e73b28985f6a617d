"""Contract of a simulated physics, which nodes and the direct backend read, drive and break."""

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np


class World(Protocol):
    """Simulated robot with its own time.

    Signals and elements are those of the robot file; arrays are float64 in SI units and in the order of the elements.
    One thread steps a world; `measure` returns arrays that no later step changes.
    """

    time: float
    """Simulated time [s]."""

    def step(self, duration: float) -> None:
        """Move the world forward by `duration` [s], with as many substeps as its physics needs."""
        ...

    def measure(self) -> Mapping[str, np.ndarray]:
        """Return the readings of ideal electronics now: with noise, without transmission; shapes (n,)."""
        ...

    def truth(self) -> Mapping[str, np.ndarray]:
        """Return every signal without noise, shapes (n,)."""
        ...

    def drive(self, element: str, target: float, enabled: bool) -> None:
        """Set the target of one servo [its signal's unit]; a servo that is not enabled holds by its brake."""
        ...

    def break_part(self, part: str) -> None:
        """Break a part of the body (`muscle_cut:biceps`); an unknown part is an error that lists the known ones."""
        ...

    def close(self) -> None:
        """Release the physics engine. Safe to call twice."""
        ...


def servo_index(servos: Mapping[str, int], element: str, target: float, kind: str = "an angle in radians") -> int:
    """Check a set-point and return the index of the servo that moves the element."""
    index = servos.get(element)
    if index is None:
        raise KeyError(f"No servo moves '{element}'. Known servos: {', '.join(servos)}.")
    if not math.isfinite(target):
        raise ValueError(f"The set-point of '{element}' is {target}; it must be {kind}.")
    return index
