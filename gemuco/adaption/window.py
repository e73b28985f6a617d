"""Window of the newest samples of a body."""

import numpy as np


class Window:
    """Samples [standard deviations] in a ring: the oldest are replaced, and every k-th of the newest is held out.

    A sample is held out when it comes, and is learned from once `judges` newer ones are held out in its place. So it
    never judges a W that learned from it, and no sample is lost.

    Args:
        size: Maximum number of samples.
        width: Elements of a sample.
        held_out: k; 0 holds none out.
        judges: Maximum number of samples that are held out at a time.
    """

    def __init__(self, size: int, width: int, held_out: int, judges: int) -> None:
        self._rows = np.full((size, width), np.nan, np.float32)
        self._serial = np.full(size, -1)
        self._held_out, self._judges = held_out, judges
        self._learned: np.ndarray | None = None
        self.added = 0
        self.dropped = 0

    def __len__(self) -> int:
        """Return the number of samples in the window."""
        return int((self._serial >= 0).sum())

    def add(self, row: np.ndarray) -> None:
        """Put a sample in, shape (width,), in place of the oldest if the window is full."""
        slot = self.added % len(self._rows)
        self.dropped += bool(self._serial[slot] >= 0)
        self._rows[slot] = row
        self._serial[slot] = self.added
        self.added += 1
        self._learned = None

    def forget_before(self, serial: int) -> None:
        """Drop the samples before the one with a number; the first sample has number 0."""
        old = (self._serial >= 0) & (self._serial < serial)
        self.dropped += int(old.sum())
        self._serial[old] = -1
        self._learned = None

    def forget_from(self, serial: int) -> None:
        """Drop the sample with a number, and all newer ones."""
        new = self._serial >= serial
        self.dropped += int(new.sum())
        self._serial[new] = -1
        self._learned = None

    def rows(self) -> np.ndarray:
        """Return all samples, oldest first, shape (n, width)."""
        index = np.flatnonzero(self._serial >= 0)
        return self._rows[index[np.argsort(self._serial[index])]]

    def learned(self) -> np.ndarray:
        """Return the samples to learn from, shape (n, width), in no particular order."""
        if self._learned is None:
            kept = self._serial >= 0
            self._learned = self._rows[kept & ~self._held()]
        return self._learned

    def held(self) -> np.ndarray:
        """Return the held-out samples, shape (n, width), in no particular order."""
        return self._rows[(self._serial >= 0) & self._held()]

    def _held(self) -> np.ndarray:
        if not self._held_out:
            return np.zeros(len(self._serial), bool)
        is_new = self._serial >= self.added - self._judges * self._held_out
        return is_new & (self._serial % self._held_out == self._held_out - 1)
