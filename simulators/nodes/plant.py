"""View of the world for the nodes of a robot: the newest measurement, swapped whole."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One measurement of the world.

    Attributes:
        time: Simulated time [s].
        values: By signal, as `World.measure` gives them; shapes (n,).
    """

    time: float
    values: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(slots=True)
class Plant:
    """The newest snapshot, written by the physics and read by every node."""

    places: Mapping[str, tuple[str, int]]
    """`signal.element` -> signal and position in it."""
    snapshot: Snapshot
    lies: dict[str, Callable[[float, float], float]] = field(default_factory=dict)
    """`signal.element` -> what its sensor makes of the true value and the time [s] (`simulators.lies`)."""
    swapped: dict[str, str] = field(default_factory=dict)
    """`signal.element` -> the element that its sensor measures in place of its own."""

    def read(self, element: str) -> float:
        """Return the newest value of an element as its sensor measures it [its signal's unit]."""
        true = self.value(self.swapped.get(element, element))
        lie = self.lies.get(element)
        return true if lie is None else lie(true, self.snapshot.time)

    def value(self, element: str) -> float:
        """Return the newest value of an element without a lie [its signal's unit]."""
        signal, index = self.places[element]
        return float(self.snapshot.values[signal][index])

    @property
    def time(self) -> float:
        """Simulated time [s] of the snapshot."""
        return self.snapshot.time
