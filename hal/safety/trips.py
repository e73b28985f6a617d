"""When no limit of a command is enough: values at which the robot stops."""

from collections.abc import Sequence

import numpy as np

from hal.config import RobotConfig, per_element
from hal.safety.ends import Way
from hal.safety.limit import Arrays

START_TOLERANCE = 0.02
"""A robot may be enabled so far out of range, as a part of the range: what noise and sagging explain."""
OVERRUN = 0.05
"""A robot that is enabled and so far out of range, as a part of it, stops: something moves it against its command."""


class Trips:
    """Measured values that stop the robot: over `trip_high`, under `trip_low`, or a position beyond its range."""

    def __init__(self, config: RobotConfig, positions: Sequence[Way]) -> None:
        """`positions` are those of the commanded elements, with their ranges."""
        self._config = config
        self._positions = tuple(positions)
        self._bounds = []
        for signal, limit in config.limits.items():
            if limit.trip_low is not None or limit.trip_high is not None:
                size, where = config.signals[signal].size, f"limits.{signal}"
                low = per_element(limit.trip_low, size, f"{where}.trip_low", -np.inf)
                high = per_element(limit.trip_high, size, f"{where}.trip_high", np.inf)
                self._bounds.append((signal, low, high))
        self._beyond = [(way, *_widened(way, OVERRUN)) for way in self._positions]

    def trip(self, measured: Arrays) -> str:
        """Why the robot must stop, in a sentence; empty if it need not. Values that are not valid trip nothing."""
        for signal, low, high in self._bounds:
            values = measured[signal]
            out = (values > high) | (values < low)
            if out.any():
                return self._tell(signal, int(np.argmax(out)), values, low, high)
        for way, low, high in self._beyond:
            values = way.read(measured)
            out = (values > high) | (values < low)
            if out.any():
                place = int(np.argmax(out))
                return (
                    f"{way.signal}.{way.elements[place]} is {values[place]:.4g}, beyond its range of "
                    f"{way.low[place]:.4g} to {way.high[place]:.4g}. What moves it?"
                )
        return ""

    def _tell(self, signal: str, place: int, values: np.ndarray, low: np.ndarray, high: np.ndarray) -> str:
        name, value = self._config.signals[signal].elements[place], values[place]
        if value > high[place]:
            return (
                f"{signal}.{name} is {value:.4g}, over its trip limit of {high[place]:g}. What is the robot caught on?"
            )
        return f"{signal}.{name} is {value:.4g}, under its trip limit of {low[place]:g}. What came loose?"

    def excluded(self, measured: Arrays) -> str:
        """Why the robot must not be enabled where it is, in a sentence; empty if it may.

        A drive that is pulled into range from far outside would pull for long, on the word of a calibration that may
        be off.
        """
        for way in self._positions:
            low, high = _widened(way, START_TOLERANCE)
            values = way.read(measured)
            out = np.flatnonzero((values < low) | (values > high))
            if len(out):
                told = ", ".join(
                    f"{way.elements[i]} {values[i]:.4g} (allowed: {way.low[i]:.4g} to {way.high[i]:.4g})" for i in out
                )
                return f"Far outside limits.{way.signal}: {told}. Are zero and direction of these drives right?"
        return self.trip(measured)


def _widened(way: Way, part: float) -> tuple[np.ndarray, np.ndarray]:
    """The range and a part of it more on both sides; infinite where it is not a range."""
    margin = part * (way.high - way.low)
    return way.low - margin, way.high + margin
