"""What a command may become before it is applied: range, rate, and the tension of the muscle it pulls."""

import numpy as np

from hal.config import LimitConfig, RobotConfig
from hal.sample import Arrays

SOFT_BAND = 0.1
"""Part of `soft_high` below it within which shortening is slowed down, so that a muscle comes to rest at the limit
instead of chattering about it."""

MISPLACED = 0.1
"""A position further out of range than this part of the range is not believed."""


class Limiter:
    """Turns a desired set-point into one that may be applied.

    Every change of the set-point is a step from the one applied before, so that no command, however it jumps, moves a
    drive faster than `rate`. A muscle (an element of the commanded signal that has a namesake in a signal with
    `soft_high`) is shortened more slowly as its tension nears `soft_high` [N], not at all at it, and paid out above
    it, in proportion, at the full rate where the tension reaches `trip_high`.
    """

    def __init__(self, config: RobotConfig, period: float) -> None:
        """Prepare the limits of `config` for steps of `period` [s]."""
        name = config.command.signal
        limit = config.limits.get(name, LimitConfig())
        self._low, self._high = config.bounds(name)
        self._step = np.inf if limit.rate is None else limit.rate * period
        span = np.where(np.isfinite(self._high - self._low), self._high - self._low, 1.0)
        self._pay_out = np.minimum(self._step, span * period)
        self._tension: str | None = None
        self._trips = {signal: one.trip_high for signal, one in config.limits.items() if one.trip_high}
        self._elements = {signal: one.elements for signal, one in config.signals.items()}
        elements = config.signals[name].elements
        for signal, other in config.limits.items():
            if other.soft_high and signal != name:
                self._watch_tension(signal, other, elements)

    def _watch_tension(self, signal: str, limit: LimitConfig, commanded: tuple[str, ...]) -> None:
        names = self._elements[signal]
        pairs = [(index, names.index(element)) for index, element in enumerate(commanded) if element in names]
        if not pairs or limit.soft_high is None:
            return
        self._tension = signal
        self._muscle, self._cell = (np.array(part) for part in zip(*pairs, strict=True))
        self._soft = limit.soft_high
        self._over = (limit.trip_high or 2 * limit.soft_high) - limit.soft_high

    def step(
        self, desired: np.ndarray, before: np.ndarray, measured: Arrays, commanded: bool = True
    ) -> tuple[np.ndarray, list[str]]:
        """The set-point to apply, and which limits shaped it.

        Args:
            desired: What is asked for [unit of the commanded signal], shape (n,).
            before: What was applied in the cycle before, shape (n,).
            measured: The newest valid values; an element that is NaN limits nothing.
            commanded: Whether `desired` comes from outside; a set-point that is merely held is not pulled into range.

        Returns:
            Applied set-points, shape (n,), and a sorted subset of `range`, `rate`, `tension`.
        """
        limited = []
        if commanded:
            inside = np.minimum(np.maximum(desired, self._low), self._high)
            if (inside != desired).any():
                limited.append("range")
            desired = inside
        wanted = desired - before
        step = np.minimum(np.maximum(wanted, -self._step), self._step)
        if (step != wanted).any():
            limited.append("rate")
        if self._tension is not None and self._relax(step, before, measured[self._tension]):
            limited.append("tension")
        return before + step, limited

    def _relax(self, step: np.ndarray, before: np.ndarray, tension: np.ndarray) -> bool:
        """Raise the steps [unit] of tense muscles in place; whether any was raised."""
        tension = tension[self._cell]
        tense = tension > self._soft * (1 - SOFT_BAND)
        if not tense.any():
            return False
        headroom = (self._soft - tension) / (SOFT_BAND * self._soft)
        excess = np.minimum((tension - self._soft) / self._over, 1.0)
        least = self._pay_out[self._muscle] * np.where(tension > self._soft, excess, -headroom)
        room = np.maximum(self._high - before, 0.0)[self._muscle]
        mine = step[self._muscle]
        raised = np.where(tense, np.maximum(mine, np.minimum(least, room)), mine)
        step[self._muscle] = raised
        return bool((raised != mine).any())

    def misplaced(self, measured: np.ndarray) -> list[int]:
        """Which measured elements of the commanded signal, shape (n,), are so far out of range that they must be wrong.

        A drive that is pulled into range from there would pull for long, on the word of a calibration that is off.
        """
        margin = MISPLACED * (self._high - self._low)
        wrong = (measured < self._low - margin) | (measured > self._high + margin)
        return [int(index) for index in np.flatnonzero(wrong)]

    def trip(self, measured: Arrays) -> str | None:
        """A sentence if a measured value is over its `trip_high`, else None; invalid values trip nothing."""
        for signal, high in self._trips.items():
            over = measured[signal] > high
            if over.any():
                index = int(np.argmax(over))
                name, value = self._elements[signal][index], measured[signal][index]
                return f"{signal}.{name} is {value:.4g}, over its trip limit of {high:g}. What is the robot caught on?"
        return None

    def blind(self, measured: Arrays) -> list[str]:
        """Commanded elements whose tension is not known, so that its soft limit cannot act."""
        if self._tension is None:
            return []
        names = self._elements[self._tension]
        return [names[cell] for cell in self._cell if not np.isfinite(measured[self._tension][cell])]
