"""Measured values at which the robot stops."""

from collections.abc import Sequence

import numpy as np

from hal.config import RobotConfig, per_element
from hal.safety.feedback import Arrays, MeasuredRange

START_TOLERANCE = 0.02
"""A robot may be enabled this far out of range, as a part of the range, because of noise and sagging."""
OVERRUN = 0.05
"""An enabled robot stops if it is farther out of range, as a part of the range: it moves against its command."""


class Trips:
    """Check for measured values over `trip_high`, under `trip_low`, or a position beyond its range."""

    def __init__(self, config: RobotConfig, positions: Sequence[MeasuredRange]) -> None:
        """Prepare; `positions` are those of the commanded elements."""
        self._config = config
        self._positions = tuple(positions)
        self._bounds = []
        for signal, limit in config.limits.items():
            if limit.trip_low is not None or limit.trip_high is not None:
                size, where = config.signals[signal].size, f"limits.{signal}"
                low = per_element(limit.trip_low, size, f"{where}.trip_low", -np.inf)
                high = per_element(limit.trip_high, size, f"{where}.trip_high", np.inf)
                self._bounds.append((signal, low, high))
        self._beyond = [(position, *_widened(position, OVERRUN)) for position in self._positions]

    def trip(self, measured: Arrays) -> str:
        """Return the reason to stop the robot, as a sentence; empty without one. Invalid values are no reason."""
        for signal, low, high in self._bounds:
            values = measured[signal]
            out = (values > high) | (values < low)
            if out.any():
                return self._text(signal, int(np.argmax(out)), values, low, high)
        for position, low, high in self._beyond:
            values = position.read(measured)
            out = (values > high) | (values < low)
            if out.any():
                place = int(np.argmax(out))
                return (
                    f"{position.signal}.{position.elements[place]} is {values[place]:.4g}, beyond its range of "
                    f"{position.low[place]:.4g} to {position.high[place]:.4g}. What moves it?"
                )
        return ""

    def _text(self, signal: str, place: int, values: np.ndarray, low: np.ndarray, high: np.ndarray) -> str:
        name, value = self._config.signals[signal].elements[place], values[place]
        if value > high[place]:
            return f"{signal}.{name} is {value:.4g}, over its trip limit of {high[place]:g}. Is the robot blocked?"
        return f"{signal}.{name} is {value:.4g}, under its trip limit of {low[place]:g}. Is a part loose?"

    def excluded(self, measured: Arrays) -> str:
        """Return the reason not to enable the robot at its present position; empty without one.

        A drive far outside of its range would move for long, based on a calibration that may be wrong.
        """
        for position in self._positions:
            low, high = _widened(position, START_TOLERANCE)
            values = position.read(measured)
            out = np.flatnonzero((values < low) | (values > high))
            if len(out):
                listing = ", ".join(
                    f"{position.elements[i]} {values[i]:.4g} (allowed: {position.low[i]:.4g} to {position.high[i]:.4g})"
                    for i in out
                )
                return f"Far outside limits.{position.signal}: {listing}. Are zero and direction of these drives right?"
        return self.trip(measured)


def _widened(position: MeasuredRange, part: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the range, extended by a part of it on both sides; infinite where a bound is infinite."""
    margin = part * (position.high - position.low)
    return position.low - margin, position.high + margin
