"""The bounded window of what a body lived through: the oldest go, and every k-th is held out."""

import numpy as np


class Window:
    """Samples [standard deviations] in a ring.

    Args:
        size: Samples kept.
        width: Elements of a sample.
        held_out: Every so many-th sample is for judging and never learned from; 0 holds none out.
    """

    def __init__(self, size: int, width: int, held_out: int) -> None:
        self._rows = np.full((size, width), np.nan, np.float32)
        self._serial = np.full(size, -1)
        self._held_out = held_out
        self._learned: np.ndarray | None = None
        self.added = 0
        self.dropped = 0

    def __len__(self) -> int:
        """Samples in the window."""
        return int((self._serial >= 0).sum())

    def add(self, row: np.ndarray) -> None:
        """Put a sample in, shape (width,), in place of the oldest if the window is full."""
        place = self.added % len(self._rows)
        self.dropped += bool(self._serial[place] >= 0)
        self._rows[place] = row
        self._serial[place] = self.added
        self.added += 1
        self._learned = None

    def forget_before(self, serial: int) -> None:
        """Drop the samples that came before the one of a number (the first has number 0)."""
        old = (self._serial >= 0) & (self._serial < serial)
        self.dropped += int(old.sum())
        self._serial[old] = -1
        self._learned = None

    def learned(self) -> np.ndarray:
        """The samples to learn from, shape (n, width), in no particular order."""
        if self._learned is None:
            there = self._serial >= 0
            self._learned = self._rows[there & ~self._held()] if self._held_out else self._rows[there]
        return self._learned

    def held(self, most: int) -> np.ndarray:
        """At most so many of the newest held-out samples, newest first, shape (n, width)."""
        if not self._held_out:
            return self._rows[:0]
        return self._newest((self._serial >= 0) & self._held(), most)

    def newest(self, most: int) -> np.ndarray:
        """At most so many of the newest samples, newest first, shape (n, width)."""
        return self._newest(self._serial >= 0, most)

    def _held(self) -> np.ndarray:
        return self._serial % self._held_out == self._held_out - 1

    def _newest(self, chosen: np.ndarray, most: int) -> np.ndarray:
        index = np.flatnonzero(chosen)
        return self._rows[index[np.argsort(self._serial[index])[::-1][:most]]]
