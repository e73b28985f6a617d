"""Whether a robot may be enabled where it is."""

from collections.abc import Sequence

import numpy as np

from hal.errors import CommandRefused
from hal.limits import Limiter
from hal.safety.limit import Arrays

MEMORY = 0.25
"""The robot may be enabled where all its drives were seen not longer ago [s]: a lost frame is no obstacle."""


class Start:
    """Remembers where the robot was when all of the commanded signal was last known.

    Attributes:
        known: Signal -> values of that cycle [its unit].
    """

    def __init__(self, signal: str, elements: Sequence[str]) -> None:
        self.known: Arrays = {}
        self._signal, self._elements = signal, tuple(elements)
        self._seen = -np.inf
        self._newest = np.full(len(self._elements), np.nan)

    def note(self, measured: Arrays, now: float) -> None:
        """What the cycle at monotonic time `now` [s] measured."""
        self._newest = measured[self._signal]
        if np.isfinite(self._newest).all():
            self.known, self._seen = measured, now

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
