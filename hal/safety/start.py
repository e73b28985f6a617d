"""Whether a robot may be enabled where it is."""

from collections import deque

import numpy as np

from hal.config import RobotConfig
from hal.errors import CommandRefused
from hal.safety.limit import Arrays
from hal.safety.limiter import Limiter

MEMORY = 0.25
"""The robot may be enabled where all its drives were seen not longer ago [s]: a lost frame is no obstacle."""
MOVED = 0.05
"""Part of its range that an element may move while the drives are being enabled: brakes open, nothing pushes yet."""


class Start:
    """Remembers where the robot was when all of the commanded signal was last known.

    Attributes:
        known: Signal -> values of that cycle [its unit].
    """

    def __init__(self, config: RobotConfig, quantity: str) -> None:
        """Know of nothing yet.

        Args:
            config: The robot file.
            quantity: What the drives are commanded in; only positions have a place to start from.
        """
        self.known: Arrays = {}
        self._recent: deque[np.ndarray] = deque(maxlen=3)
        self._signal = config.command.signal
        self._elements = config.signals[self._signal].elements
        self._seen = -np.inf
        self._newest = self._asked = np.full(len(self._elements), np.nan)
        low, high = config.bounds(self._signal)
        self._may_move = MOVED * (high - low) if quantity == "position" else np.full(len(self._elements), np.inf)

    def note(self, measured: Arrays, now: float) -> None:
        """What the cycle at monotonic time `now` [s] measured."""
        self._newest = measured[self._signal]
        if now - self._seen > MEMORY:  # it may have been moved while nobody looked
            self._recent.clear()
        if np.isfinite(self._newest).all():
            self.known, self._seen = measured, now
            self._recent.append(self._newest)

    def check(self, now: float, limiter: Limiter) -> None:
        """Look before anything is enabled.

        Raises:
            CommandRefused: A commanded element is not known, or the limits exclude where the robot is.
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
        self._asked = self.believed()[self._signal]

    def believed(self) -> Arrays:
        """The middle one of the last three measurements of the commanded signal: one wrong one is not followed."""
        return {self._signal: np.median(self._recent, axis=0)}

    def moved(self, measured: Arrays) -> str:
        """What has moved further since `check` than can be while the drives are being enabled; empty if nothing has."""
        wrong = np.flatnonzero(np.abs(measured[self._signal] - self._asked) > self._may_move)
        if not wrong.size:
            return ""
        index = int(wrong[0])
        return (
            f"{self._signal}.{self._elements[index]} went from {self._asked[index]:.4g} to "
            f"{measured[self._signal][index]:.4g} while the drives were being enabled. Does it move by itself, or does "
            "another node send in its name?"
        )
