"""Soft limits of measured loads: tension of a muscle, effort of a joint."""

import numpy as np
from typing_extensions import override

from hal.safety.feedback import Load
from hal.safety.limit import CycleState, Limit, changed, fastest

SOFT_BAND = 0.1
"""The command slows down within this part of `soft_high` below it, so that it comes to rest there and does not
oscillate."""
GROWTH = 0.02
"""An effort command may grow by this part per cycle at the lower end of the band."""


class SoftLimit(Limit):
    """Soft limit of a load; an element with an unknown load is not limited, and reported by `blind`."""

    def __init__(self, load: Load) -> None:
        self.name = self.needs = "effort" if load.is_signed else "tension"
        self.feedback = self._load = load
        self._lower = (1 - SOFT_BAND) * load.soft
        self._over = load.hard - load.soft

    def _outwards(self, load: np.ndarray) -> np.ndarray | float:
        """Return the sign of a motion towards relief, shape (k,) or one for all."""
        return np.where(load > 0, -1.0, 1.0) if self._load.is_signed else 1.0

    def _relief(self, size: np.ndarray) -> np.ndarray:
        """Return the speed towards relief as a part of the highest, shape (k,); if negative, the load may increase."""
        below = (size - self._load.soft) / (SOFT_BAND * self._load.soft)
        return np.where(size > self._load.soft, np.minimum((size - self._load.soft) / self._over, 1.0), below)


class SoftEffort(SoftLimit):
    """Soft limit of a position command.

    Above `soft` a set-point moves towards relief, faster as the load comes closer to `hard`. In the band below `soft`
    the load may increase, slower and slower.
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
            load: Load of the commanded elements.
            relief: Highest speed towards relief [unit/s], shape (k,).
            low: Lowest set-point [unit], where relief ends, shape (k,).
            high: Highest set-point [unit], shape (k,).
            period: Period of a cycle [s].
            deceleration: Deceleration of a set-point at the end [unit/s^2], shape (k,); None for no limit.
        """
        super().__init__(load)
        self._highest, self._low, self._high = relief, low, high
        self._period, self._deceleration = period, deceleration

    @override
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        load = self._load.read(state.measured)
        size = np.abs(load) if self._load.is_signed else load
        loaded = size > self._lower
        if not loaded.any():
            return desired
        places = self._load.commanded
        before = state.before[places]
        outwards = self._outwards(load)
        least = self._highest * self._relief(size)
        room = np.where(outwards > 0, self._high - before, before - self._low)
        if self._deceleration is None:
            room = np.maximum(room, 0.0) / self._period
        else:
            room = fastest(room, self._deceleration, self._period)
        least = np.minimum(least, room) * self._period
        way = outwards * (desired[places] - before)
        limited = desired.copy()
        limited[places] = np.where(loaded & (way < least), before + outwards * least, desired[places])
        return changed(limited, desired)


class SoftEffortOfVelocity(SoftLimit):
    """Soft limit of a velocity command.

    Above `soft` the velocity is towards relief. In the band below, a velocity that adds load is reduced.
    """

    def __init__(self, load: Load, relief: np.ndarray) -> None:
        """Prepare; `relief` is the highest velocity towards relief [unit of the commanded signal], shape (k,)."""
        super().__init__(load)
        self._highest = relief

    @override
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        load = self._load.read(state.measured)
        size = np.abs(load) if self._load.is_signed else load
        loaded = size > self._lower
        if not loaded.any():
            return desired
        places = self._load.commanded
        outwards = self._outwards(load)
        least = self._highest * self._relief(size)
        limited = desired.copy()
        limited[places] = np.where(loaded, outwards * np.maximum(outwards * desired[places], least), desired[places])
        return changed(limited, desired)


class SoftEffortOfEffort(SoftLimit):
    """Soft limit of an effort command, which shrinks by a small part per cycle while the load is too high.

    It scales the set-point of the last cycle and not the desired one, so that a load that follows the command one cycle
    later settles at `soft` and does not oscillate.
    """

    @override
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        size = np.abs(self._load.read(state.measured))
        loaded = size > self._lower
        if not loaded.any():
            return desired
        places = self._load.commanded
        headroom = np.clip((self._load.soft - size) / (SOFT_BAND * self._load.soft), -1.0, 1.0)
        most = np.abs(state.before[places]) * (1.0 + GROWTH * headroom)
        own = desired[places]
        limited = desired.copy()
        limited[places] = np.where(loaded, np.minimum(np.maximum(own, -most), most), own)
        return changed(limited, desired)
