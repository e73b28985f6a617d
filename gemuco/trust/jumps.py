"""Jumps of elements in their own values: of those that contradict each other, the one that jumped is wrong.

Two encoders of one axis predict each other better than all others predict either, so an offset of one is as well one of
the other. But the body moves smoothly, and only the wrong one has jumped when the contradiction began.
"""

from collections import deque

import numpy as np

from gemuco.trust.changes import LONGEST
from gemuco.trust.config import Hidden

EARLIER = 3
"""A change may have begun this number of blocks before it is dated."""
KNOWN = 50
"""The usual jumps of an element are known after this number of blocks."""
MEMORY = 6000.0
"""They are remembered for this number of blocks."""
JUMPED, ALONE, TOGETHER = 2.0, 3.0, 2
"""An element jumped from the first multiple of its largest usual jump on; and it alone if the multiple is the second
number of times that of all others. A knock at the body is a jump of more than the third number of elements."""
ONE_JUMP = 2
"""One jump is seen in at most this number of blocks."""
WORTH, LEAST = 1.0, 0.1
"""A jump has at least the first size, a usual one counts as at least the second [errors of a healthy prediction]."""


class Jumps:
    """Second differences of the values of all judged elements: the newest, and the largest usual ones."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._recent: deque[np.ndarray] = deque(maxlen=LONGEST + EARLIER)
        self._usual, self._count = np.zeros(1), 0

    def add(self, values: np.ndarray) -> None:
        """Add the values of one block [standard deviations], shape (samples, elements), NaN where missing."""
        if self._last is not None:
            values = np.concatenate([self._last, values])
        bends = np.abs(np.diff(values, n=2, axis=0))
        self._recent.append(np.where(np.isfinite(bends), bends, 0.0).max(axis=0, initial=0.0))
        self._last = values[-2:]

    def learn(self, hidden: Hidden) -> None:
        """Learn the usual jumps from the oldest block, because those that began a lie are noticed before it is."""
        if len(self._recent) < LONGEST + EARLIER:
            return
        self._count += 1
        jump = self._recent[0].copy()
        jump[[column for column in hidden if column < len(jump)]] = 0.0
        if self._count > KNOWN:
            jump = np.minimum(jump, 2.0 * self._usual)
        self._usual = np.maximum(self._usual * (1.0 - 1.0 / MEMORY), jump)

    def sudden(self, age: int, error: np.ndarray) -> Hidden:
        """Return the columns that jumped within about the newest `age` blocks while all others moved as usual.

        Args:
            age: Number of blocks.
            error: Errors of a healthy prediction [standard deviations], shape (columns,), of p behind the elements.
        """
        if self._count < KNOWN:
            return frozenset()
        newest = np.max(list(self._recent)[-age - EARLIER :], axis=0)
        ratio, jumped = self._ratio(newest, error)
        others = ratio[~jumped].max(initial=1.0)
        is_alone = 0 < jumped.sum() <= TOGETHER and ratio[jumped].min() > ALONE * others
        return frozenset(np.flatnonzero(jumped).tolist()) if is_alone else frozenset()

    def is_restless(self, columns: Hidden, error: np.ndarray) -> bool:
        """Whether one of some columns jumped more than once lately, as one with noise does; `error` as in `sudden`."""
        if self._count < KNOWN:
            return False
        own = [column for column in columns if column < len(self._usual)]
        jumped = [self._ratio(newest, error)[1][own].any() for newest in list(self._recent)[-LONGEST:]]
        return bool(sum(jumped) > ONE_JUMP)

    def _ratio(self, newest: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the multiples of the largest usual jumps, and which are jumps, shapes (elements,)."""
        error = error[: len(newest)]
        ratio = newest / np.maximum(self._usual, LEAST * error)
        return ratio, (ratio > JUMPED) & (newest > WORTH * error)
