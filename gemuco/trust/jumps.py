"""Jumps and repeats of elements in their own values, whatever the others say of them.

Two encoders of one axis predict each other better than all others predict either, so an offset of one is as well one of
the other. But the body moves smoothly, and only the wrong one has jumped when the contradiction began. And a frozen
value may be nearly right for a long time, but its noise is missing: a noisy sensor that repeats to the last bit while
the body moves is stuck.
"""

from collections import deque

import numpy as np

from gemuco.trust.changes import LONGEST
from gemuco.trust.config import BLOCK, Hidden

EARLIER = 3
"""A change may have begun this number of blocks before it is dated."""
KNOWN = 50
"""The usual jumps of an element are known after this number of blocks."""
MEMORY = 6000.0
"""They, and the longest usual runs of equal values, are remembered for this number of blocks."""
JUMPED, ALONE, TOGETHER = 2.0, 3.0, 2
"""An element jumped from the first multiple of its largest usual jump on; and it alone if the multiple is the second
number of times that of all others. A knock at the body is a jump of more than the third number of elements."""
DRIFTED, RESTED = 3.0, 1.5
"""An element moved alone if it moved by at least the first number of healthy errors and as many times as far as all
others, which moved by at most the second number of their own."""
STALLED, PAUSES = 1.5, 20
"""If the block before ended longer ago than the first multiple of the shortest of the second number of pauses, or of
`BLOCK`, what moves looks as if it had jumped since."""
ONE_JUMP = 2
"""One jump is seen in at most this number of blocks."""
WORTH, LEAST = 1.0, 0.1
"""A jump has at least the first size, a usual one counts as at least the second [errors of a healthy prediction]."""
STUCK, LONGER = 5.0, 3.0
"""A sensor is stuck if its value repeats for the first number of blocks of motion at the usual pace, and for the second
multiple of its longest usual run."""
PREDICTED = 1.5
"""Meanwhile its prediction moves by at least this [errors of a healthy prediction]."""
CALM, CALM_BLOCKS = 0.3, 30
"""While its prediction moves by less than the first number of healthy errors per block, a noisy sensor changes all the
same. It is known to be one after the second number of such blocks: while the body moves every value changes."""
HELD, LONGER_HELD, MOST = 0.5, 2.0, 0.5
"""An element holds its value if it repeats for the first number of blocks of motion at the usual pace, and for the
second multiple of its longest usual one, and no other one does for longer than usual. A motion in which more than the
third share of all elements repeat shows nothing of them: they rest."""


def moved_alone(values: np.ndarray, error: np.ndarray, left: Hidden = frozenset()) -> Hidden:
    """Return the column that moved while all others rested; empty if none did.

    It is none either if one of the others left what was learned: where a wire that bore little is cut, its tension
    falls by less than a healthy error, and a joint moves.

    Args:
        values: Means of some blocks [standard deviations], shape (blocks, columns), NaN where missing.
        error: Errors of a healthy prediction [standard deviations], shape (columns,).
        left: Columns that left what was learned lately.
    """
    if len(values) < 2:
        return frozenset()
    way = np.nan_to_num(np.ptp(values, axis=0)) / error
    first = int(way.argmax())
    others = np.delete(way, first).max(initial=0.0)
    is_alone = others <= RESTED and way[first] >= DRIFTED * max(others, 1.0)
    return frozenset({first}) if is_alone and left <= {first} else frozenset()


class Jumps:
    """Second differences of the values of all judged elements: the newest, and the largest usual ones."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._recent: deque[np.ndarray] = deque(maxlen=LONGEST + EARLIER)
        self._usual, self._count = np.zeros(1), 0
        self._pauses = deque([BLOCK], maxlen=PAUSES)

    def add(self, values: np.ndarray, pause: float = BLOCK) -> None:
        """Add the newest block.

        Args:
            values: Samples [standard deviations], shape (samples, elements), NaN where missing.
            pause: Time since the block before [s].
        """
        if self._last is not None and pause <= STALLED * max(BLOCK, min(self._pauses)):
            values = np.concatenate([self._last, values])
        self._pauses.append(pause)
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
        ratio, jumped = self._lately(age, error)
        others = ratio[~jumped].max(initial=1.0)
        is_alone = 0 < jumped.sum() <= TOGETHER and ratio[jumped].min() > ALONE * others
        return frozenset(np.flatnonzero(jumped).tolist()) if is_alone else frozenset()

    def jumped(self, age: int, error: np.ndarray, signals: np.ndarray) -> Hidden:
        """Return all columns that jumped within about the newest `age` blocks; none if the body was knocked at.

        Args:
            age: Number of blocks.
            error: As in `sudden`.
            signals: Number of the signal of each column, shape (columns,). Many elements of one signal jump when a tool
                is changed, or a camera is moved.
        """
        if self._count < KNOWN:
            return frozenset()
        jumped = np.flatnonzero(self._lately(age, error)[1])
        is_knock = len(jumped) > TOGETHER and len(set(signals[jumped])) > 1
        return frozenset() if is_knock else frozenset(jumped.tolist())

    def _lately(self, age: int, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._ratio(np.max(list(self._recent)[-age - EARLIER :], axis=0), error)

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


class Repeats:
    """Runs of blocks in which all samples of an element repeat, and the longest usual ones."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._predicted, self._start = np.full((2, 1), np.nan)  # of one element until their number is known
        self._run, self._moved, self._usual, self._calm = np.zeros((4, 1))
        self._held, self._usually_held = np.zeros((2, 1))
        self._is_stuck = np.zeros(1, bool)

    @property
    def stuck(self) -> Hidden:
        """Numbers of the elements that are stuck."""
        return frozenset(np.flatnonzero(self._is_stuck).tolist())

    @property
    def held(self) -> Hidden:
        """Number of the only element that holds its value while all others move; empty if none or several do.

        An encoder without noise is never known to be stuck, because a joint may rest while others move. But if one of
        some elements that explain an alarm holds its value as it never did before, it is the likeliest.
        """
        is_longer = self._held >= np.maximum(HELD, self._usually_held)
        is_long = is_longer & (self._held >= LONGER_HELD * self._usually_held)
        return frozenset(np.flatnonzero(is_long).tolist()) if is_longer.sum() == 1 else frozenset()

    def add(self, values: np.ndarray, motion: float, predicted: np.ndarray, error: np.ndarray) -> None:
        """Add the newest block.

        Args:
            values: Samples [standard deviations], shape (samples, elements), NaN where missing.
            motion: How much of a look at a new posture the block is, from 0 at rest to 1.
            predicted: Predicted values [standard deviations], shape (elements,), NaN where unknown.
            error: Errors of a healthy prediction [standard deviations], shape (elements,).
        """
        rows = values if self._last is None else np.concatenate([self._last, values])
        self._last = values[-1:].copy()
        repeats = (np.diff(rows, axis=0) == 0.0).all(axis=0) & (len(rows) > 1)
        ended = np.where(repeats | self._is_stuck, 0.0, self._run)
        self._usual = np.maximum(self._usual * (1.0 - 1.0 / MEMORY), ended)
        self._run = np.where(repeats, self._run + 1.0, 0.0)
        self._moved = np.where(repeats, self._moved + motion, 0.0)
        ended = np.where(repeats, 0.0, self._held)
        self._usually_held = np.maximum(self._usually_held * (1.0 - 1.0 / MEMORY), ended)
        self._held = np.where(repeats, self._held + motion * (repeats.mean() <= MOST), 0.0)
        self._calm = self._calm + (~repeats & (np.abs(predicted - self._predicted) < CALM * error))
        self._start = np.where(repeats & np.isfinite(self._start), self._start, predicted)
        self._predicted = predicted
        is_long = (self._run >= np.maximum(STUCK, LONGER * self._usual)) & (self._moved >= STUCK)
        has_moved = np.abs(predicted - self._start) > PREDICTED * error
        self._is_stuck = repeats & (self._is_stuck | (is_long & has_moved & (self._calm >= CALM_BLOCKS)))
