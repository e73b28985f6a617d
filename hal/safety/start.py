"""Checks of the robot's position before and while its drives are enabled."""

from collections import deque

import numpy as np

from hal.config import RobotConfig
from hal.errors import CommandRefused
from hal.safety.feedback import Arrays
from hal.safety.limiter import Limiter

MEMORY = 0.25
"""All drives must have been measured within this time [s] before enabling, so that a lost frame does not matter."""
MOVED = 0.05
"""An element may move by this part of its range while the drives are enabled, because brakes open."""


class Start:
    """Start position: the last complete measurements of the commanded signal.

    Attributes:
        known: Signal -> values of the last complete cycle [its unit].
    """

    def __init__(self, config: RobotConfig, quantity: str) -> None:
        """Begin without measurements.

        Args:
            config: The robot file.
            quantity: Commanded quantity; only positions have a start position.
        """
        self.known: Arrays = {}
        self._recent: deque[np.ndarray] = deque(maxlen=3)
        self._signal = config.command.signal
        self._elements = config.signals[self._signal].elements
        self._seen = -np.inf
        self._newest = self._checked = np.full(len(self._elements), np.nan)
        low, high = config.bounds(self._signal)
        self._may_move = MOVED * (high - low) if quantity == "position" else np.full(len(self._elements), np.inf)

    def note(self, measured: Arrays, now: float) -> None:
        """Note the measurements of the cycle at monotonic time `now` [s]."""
        self._newest = measured[self._signal]
        if now - self._seen > MEMORY:  # the robot may have moved without measurements
            self._recent.clear()
        if np.isfinite(self._newest).all():
            self.known, self._seen = measured, now
            self._recent.append(self._newest)

    def check(self, now: float, limiter: Limiter) -> None:
        """Check the position before a drive is enabled.

        Raises:
            CommandRefused: A commanded element is unknown, or the position is outside of the limits.
        """
        if now - self._seen > MEMORY:
            unknown = [name for name, value in zip(self._elements, self._newest, strict=True) if not np.isfinite(value)]
            raise CommandRefused(
                f"No valid {self._signal} of {', '.join(unknown or self._elements)}, so there is nothing to start "
                "from. Is the cycle running, does the drive answer?"
            )
        excluded = limiter.excluded(self.known)
        if excluded:
            raise CommandRefused(excluded)
        self._checked = self.median()[self._signal]

    def median(self) -> Arrays:
        """Return the median of the last three measurements of the commanded signal, which ignores a single error.

        It is NaN if a drive has not been measured for longer than `MEMORY`, as when it falls silent meanwhile.
        """
        if not self._recent:
            return {self._signal: np.full(len(self._elements), np.nan)}
        return {self._signal: np.median(self._recent, axis=0)}

    def moved(self, measured: Arrays) -> str:
        """Return the element that moved too far since `check`, as a sentence; empty without one."""
        wrong = np.flatnonzero(np.abs(measured[self._signal] - self._checked) > self._may_move)
        if not wrong.size:
            return ""
        index = int(wrong[0])
        return (
            f"{self._signal}.{self._elements[index]} went from {self._checked[index]:.4g} to "
            f"{measured[self._signal][index]:.4g} while the drives were being enabled. Does it move by itself, or does "
            "another node use its identifier?"
        )
