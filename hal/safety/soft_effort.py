"""Soft stops on what is pulled or pushed: tension of a muscle, effort of a joint."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hal.safety.limit import Arrays, Turn, changed, fastest

SOFT_BAND = 0.1
"""Part of `soft_high` below it within which the command is slowed down, so that it comes to rest at the limit instead
of chattering about it."""
GROWTH = 0.02
"""Part by which an effort command may grow per cycle far below `soft_high`, once it is within the band."""


@dataclass(frozen=True, slots=True)
class Load:
    """Which measured elements load which commanded ones.

    Attributes:
        signal: Where it is measured.
        elements: Names of the measured elements that count, as many as places.
        commanded: Places in the commanded signal, shape (k,).
        measured: Places in the measured signal, shape (k,).
        soft: Load at which the command gives way [unit of the measured signal], shape (k,).
        hard: Load at which it does so as fast as it may, shape (k,).
        is_signed: Whether the load is a drive's own effort, which is relieved by moving against its sign. Otherwise
            it is the tension of a wire, which is relieved by letting the wire out.
    """

    signal: str
    elements: Sequence[str]
    commanded: np.ndarray
    measured: np.ndarray
    soft: np.ndarray
    hard: np.ndarray
    is_signed: bool = False

    def read(self, measured: Arrays) -> np.ndarray:
        """What is measured now [unit of the measured signal], shape (k,)."""
        return measured[self.signal][self.measured]

    def unknown(self, measured: Arrays) -> list[str]:
        """Names of the elements that are not measured now."""
        return [name for name, value in zip(self.elements, self.read(measured).tolist(), strict=True) if value != value]


class SoftEffort:
    """What is loaded beyond `soft` may only move towards relief, and does so, the faster the nearer it is to `hard`.

    Within the band below `soft` it may load itself further, but slower and slower. An element whose load is not known
    is not limited, and told by `blind`.
    """

    def __init__(
        self,
        load: Load,
        relief: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        period: float,
        deceleration: np.ndarray | None = None,
    ) -> None:
        """Prepare.

        Args:
            load: What is measured of what is commanded.
            relief: Highest speed towards relief [unit/s], shape (k,).
            low: Where relief ends [unit], shape (k,).
            high: Where relief ends on the other side [unit], shape (k,).
            period: Of a cycle [s].
            deceleration: How fast a set-point may come to rest there [unit/s^2], shape (k,); at once if None.
        """
        self.name = self.needs = "effort" if load.is_signed else "tension"
        self._load, self._relief, self._low, self._high = load, relief, low, high
        self._period, self._deceleration = period, deceleration
        self._watched = (1 - SOFT_BAND) * load.soft
        self._over = load.hard - load.soft

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """See `Limit.limit`."""
        load = self._load.read(turn.measured)
        size = np.abs(load) if self._load.is_signed else load
        loaded = size > self._watched
        if not loaded.any():
            return wanted
        places = self._load.commanded
        before = turn.before[places]
        outwards = np.where(load > 0, -1.0, 1.0) if self._load.is_signed else 1.0
        least = self._relief * towards_relief(size, self._load.soft, self._over)
        room = np.where(outwards > 0, self._high - before, before - self._low)
        if self._deceleration is None:
            room = np.maximum(room, 0.0) / self._period
        else:
            room = fastest(room, self._deceleration, self._period)
        least = np.minimum(least, room) * self._period
        way = outwards * (wanted[places] - before)
        limited = wanted.copy()
        limited[places] = np.where(loaded & (way < least), before + outwards * least, wanted[places])
        return changed(limited, wanted)

    def blind(self, measured: Arrays) -> list[str]:
        """See `Limit.blind`."""
        return self._load.unknown(measured)


class SoftEffortOfVelocity:
    """`SoftEffort` of a velocity command: no velocity that loads further, and one towards relief beyond `soft`."""

    def __init__(self, load: Load, relief: np.ndarray) -> None:
        """`relief` is the highest velocity towards relief [unit of the commanded signal], shape (k,)."""
        self.name = self.needs = "effort" if load.is_signed else "tension"
        self._load, self._relief = load, relief
        self._watched = (1 - SOFT_BAND) * load.soft
        self._over = load.hard - load.soft

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """See `Limit.limit`."""
        load = self._load.read(turn.measured)
        size = np.abs(load) if self._load.is_signed else load
        loaded = size > self._watched
        if not loaded.any():
            return wanted
        places = self._load.commanded
        outwards = np.where(load > 0, -1.0, 1.0) if self._load.is_signed else 1.0
        least = self._relief * towards_relief(size, self._load.soft, self._over)
        limited = wanted.copy()
        limited[places] = np.where(loaded, outwards * np.maximum(outwards * wanted[places], least), wanted[places])
        return changed(limited, wanted)

    def blind(self, measured: Arrays) -> list[str]:
        """See `Limit.blind`."""
        return self._load.unknown(measured)


class SoftEffortOfEffort:
    """`SoftEffort` of an effort command: the command shrinks, by a small part per cycle, while the load is too high.

    It works on what was applied before, not on what is wanted, so that a load that follows the command one cycle later
    settles at `soft` instead of jumping about it.
    """

    def __init__(self, load: Load) -> None:
        self.name = self.needs = "effort" if load.is_signed else "tension"
        self._load = load
        self._watched = (1 - SOFT_BAND) * load.soft

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """See `Limit.limit`."""
        size = np.abs(self._load.read(turn.measured))
        loaded = size > self._watched
        if not loaded.any():
            return wanted
        places = self._load.commanded
        headroom = np.clip((self._load.soft - size) / (SOFT_BAND * self._load.soft), -1.0, 1.0)
        most = np.abs(turn.before[places]) * (1.0 + GROWTH * headroom)
        mine = wanted[places]
        limited = wanted.copy()
        limited[places] = np.where(loaded, np.minimum(np.maximum(mine, -most), most), mine)
        return changed(limited, wanted)

    def blind(self, measured: Arrays) -> list[str]:
        """See `Limit.blind`."""
        return self._load.unknown(measured)


def towards_relief(size: np.ndarray, soft: np.ndarray, over: np.ndarray) -> np.ndarray:
    """How fast to move towards relief, as a part of the highest speed, shape (k,); negative: may load further."""
    below = (size - soft) / (SOFT_BAND * soft)
    return np.where(size > soft, np.minimum((size - soft) / over, 1.0), below)
