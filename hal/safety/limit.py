"""Contract of a limit, and the limits that need no measurement: range, rate of change, and acceleration."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

Arrays = Mapping[str, np.ndarray]


@dataclass(slots=True)
class Turn:
    """What is known when the set-point of a cycle is decided.

    Attributes:
        before: Set-point of the cycle before [unit of the commanded signal], shape (n,).
        speed: How fast it changed then [unit/s], shape (n,).
        measured: Signal -> newest valid values [its unit], shapes (m,); NaN where there is none.
        is_commanded: Whether the set-point comes from outside; one that is merely held is not pulled into range.
    """

    before: np.ndarray
    speed: np.ndarray
    measured: Arrays
    is_commanded: bool = True


class Limit(Protocol):
    """One limit of a command. Limits are asked one after the other; the last has the last word."""

    name: str
    """As told in `Applied.limited_by`."""
    needs: str
    """What must be measured for it, in a word; empty if nothing."""

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """The set-point that may be applied [unit of the commanded signal], shape (n,).

        Returns:
            `wanted` itself if it may be applied as it is, else a new array.
        """
        ...

    def blind(self, measured: Arrays) -> list[str]:
        """Elements for which a missing measurement keeps this limit from acting as it should."""
        ...


def changed(limited: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """`wanted` itself if both are the same, so that whoever asks sees at once that nothing was changed."""
    return wanted if (limited == wanted).all() else limited


def fastest(distance: np.ndarray, deceleration: np.ndarray | float, period: float) -> np.ndarray:
    """Speed [unit/s] of this cycle from which a motion can come to rest within a distance.

    In cycles of `period`, a motion that loses `deceleration * period` of speed per cycle and has n cycles left covers
    `distance = period * (n v - deceleration * period * n (n - 1) / 2)`; solved for v with the smallest whole n. The
    last of these cycles ends exactly there.

    Args:
        distance: Way that is left [unit], shape (n,); 0 where it is negative.
        deceleration: How fast it can brake [unit/s^2].
        period: Of a cycle [s].

    Returns:
        Largest speeds [unit/s], shape (n,).
    """
    left = np.maximum(distance, 0.0)
    one = deceleration * period
    cycles = np.maximum(np.ceil(0.5 * np.sqrt(1.0 + 8.0 / (one * period) * left) - 0.5), 1.0)
    return left / (cycles * period) + 0.5 * one * (cycles - 1.0)


class Range:
    """A command stays between the lowest and the highest value."""

    name = "range"
    needs = ""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        """Bounds [unit of the commanded signal], shapes (n,); infinite where there is none."""
        self._low, self._high = low, high

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """See `Limit.limit`."""
        if not turn.is_commanded:
            return wanted
        return changed(np.minimum(np.maximum(wanted, self._low), self._high), wanted)

    def blind(self, measured: Arrays) -> list[str]:
        """See `Limit.blind`; it needs no measurement."""
        return []


class Rate:
    """A set-point changes by at most so much per second: of a position that is a velocity, of a velocity a ramp."""

    name = "rate"
    needs = ""

    def __init__(self, rate: np.ndarray | float, period: float) -> None:
        """`rate` [unit/s], shape (n,) or one for all, for cycles of `period` [s]."""
        self._step = rate * period

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """See `Limit.limit`."""
        way = wanted - turn.before
        step = np.minimum(np.maximum(way, -self._step), self._step)
        return wanted if (step == way).all() else turn.before + step

    def blind(self, measured: Arrays) -> list[str]:
        """See `Limit.blind`; it needs no measurement."""
        return []


class Acceleration:
    """A position starts and stops on a ramp: it begins to brake in time to come to rest where it is to be.

    A set-point that turns back, or is held, brakes as fast as it may. As every speed it takes can be braked before the
    place that was wanted, which is in range, it never leaves the range either.
    """

    name = "acceleration"
    needs = ""

    def __init__(self, acceleration: np.ndarray | float, period: float) -> None:
        """`acceleration` [unit/s^2], shape (n,) or one for all, for cycles of `period` [s]."""
        self._acceleration, self._period = acceleration, period
        self._change = acceleration * period

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """See `Limit.limit`; `Rate` comes after it, for from the far end of one step nobody sees how far it is."""
        way = wanted - turn.before
        speed = np.copysign(fastest(np.abs(way), self._acceleration, self._period), way)
        speed = np.minimum(np.maximum(speed, turn.speed - self._change), turn.speed + self._change)
        step = speed * self._period
        arrives = np.abs(step - way) <= 1e-9 * np.abs(way)
        return wanted if arrives.all() else np.where(arrives, wanted, turn.before + step)

    def blind(self, measured: Arrays) -> list[str]:
        """See `Limit.blind`; it needs no measurement."""
        return []
