"""Contract of a limit, and the limits that need no measurement: range, rate of change, and acceleration."""

import abc
from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from hal.safety.feedback import Arrays, Feedback


@dataclass(slots=True)
class CycleState:
    """State of the robot at the decision of a set-point.

    Attributes:
        before: Set-point of the last cycle [unit of the commanded signal], shape (n,).
        speed: Speed of its change [unit/s], shape (n,).
        measured: Signal -> newest valid values [its unit], shapes (m,); NaN where not valid.
        is_commanded: Whether the set-point is commanded; a held set-point is not moved into the range.
    """

    before: np.ndarray
    speed: np.ndarray
    measured: Arrays
    is_commanded: bool = True


class Limit(abc.ABC):
    """One limit of a command. Limits are applied in sequence; a later limit has priority."""

    name: str
    """Name in `Applied.limited_by`."""
    needs: str = ""
    """Quantity that must be measured; empty without one."""
    feedback: Feedback | None = None
    """Measured elements that the limit needs."""

    @abc.abstractmethod
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        """Return the set-point that may be applied [unit of the commanded signal], shape (n,).

        Returns:
            `desired` itself if it may be applied unchanged, otherwise a new array.
        """

    def blind(self, measured: Arrays) -> list[str]:
        """Return the elements whose measurement the limit needs and does not have."""
        return self.feedback.unknown(measured) if self.feedback else []


def changed(limited: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """Return `desired` itself if both are equal, so that a caller can compare objects."""
    return desired if (limited == desired).all() else limited


def fastest(distance: np.ndarray, deceleration: np.ndarray | float, period: float) -> np.ndarray:
    """Return the speed [unit/s] of this cycle from which a motion can come to rest within a distance.

    In cycles of `period`, a motion that loses `deceleration * period` of speed per cycle and has n cycles left covers
    `distance = period * (n v - deceleration * period * n (n - 1) / 2)`; solved for v with the smallest whole n. The
    last of these cycles ends exactly at the distance.

    Args:
        distance: Remaining way [unit], shape (n,); 0 where it is negative.
        deceleration: Deceleration [unit/s^2].
        period: Period of a cycle [s].

    Returns:
        Largest speeds [unit/s], shape (n,).
    """
    left = np.maximum(distance, 0.0)
    one = deceleration * period
    cycles = np.maximum(np.ceil(0.5 * np.sqrt(1.0 + 8.0 / (one * period) * left) - 0.5), 1.0)
    return left / (cycles * period) + 0.5 * one * (cycles - 1.0)


class Range(Limit):
    """Lowest and highest value of a command."""

    name = "range"

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        """Set the bounds [unit of the commanded signal], shapes (n,); infinite for none."""
        self._low, self._high = low, high

    @override
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        if not state.is_commanded:
            return desired
        return changed(np.minimum(np.maximum(desired, self._low), self._high), desired)


class Rate(Limit):
    """Largest change of a set-point per second: the velocity of a position, the ramp of a velocity."""

    name = "rate"

    def __init__(self, rate: np.ndarray | float, period: float) -> None:
        """Set the `rate` [unit/s], shape (n,) or one for all, for cycles of `period` [s]."""
        self._step = rate * period

    @override
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        way = desired - state.before
        step = np.minimum(np.maximum(way, -self._step), self._step)
        return desired if (step == way).all() else state.before + step


class Acceleration(Limit):
    """Largest acceleration of a position: it brakes in time to come to rest at its target.

    A set-point that reverses, or is held, brakes at the largest deceleration. It can always brake before the target,
    which is in range, so it does not leave the range.
    """

    name = "acceleration"

    def __init__(self, acceleration: np.ndarray | float, period: float) -> None:
        """Set the `acceleration` [unit/s^2], shape (n,) or one for all, for cycles of `period` [s]."""
        self._acceleration, self._period = acceleration, period
        self._change = acceleration * period

    @override
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        """Return the next set-point; `Rate` must come after this limit, which needs the full distance to the target."""
        way = desired - state.before
        speed = np.copysign(fastest(np.abs(way), self._acceleration, self._period), way)
        speed = np.minimum(np.maximum(speed, state.speed - self._change), state.speed + self._change)
        step = speed * self._period
        arrives = np.abs(step - way) <= 1e-9 * np.abs(way)
        return desired if arrives.all() else np.where(arrives, desired, state.before + step)
