"""Values that repeat to the last bit: a noisy sensor that does so while the body moves is stuck.

A frozen value may be nearly right for a long time. But its noise is missing.
"""

import numpy as np

from gemuco.trust.config import Hidden

STUCK, LONGER = 5.0, 3.0
"""A sensor is stuck if its value repeats for the first number of blocks of motion at the usual pace, and for the second
multiple of its longest usual run."""
MOVED = 1.5
"""Meanwhile its prediction moves by at least this [errors of a healthy prediction]."""
MEMORY = 6000.0
"""Usual runs are remembered for this number of blocks."""
CALM, CALM_BLOCKS = 0.3, 30
"""While its prediction moves by less than the first number of healthy errors per block, a noisy sensor changes all the
same. It is known to be one after the second number of such blocks: while the body moves every value changes."""


class Repeats:
    """Runs of blocks in which all samples of an element repeat, and the longest usual ones."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._predicted, self._start = np.full((2, 1), np.nan)  # of one element until their number is known
        self._run, self._moved, self._usual, self._calm = np.zeros((4, 1))
        self._is_stuck = np.zeros(1, bool)

    @property
    def stuck(self) -> Hidden:
        """Numbers of the elements that are stuck."""
        return frozenset(np.flatnonzero(self._is_stuck).tolist())

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
        self._calm = self._calm + (~repeats & (np.abs(predicted - self._predicted) < CALM * error))
        self._start = np.where(repeats & np.isfinite(self._start), self._start, predicted)
        self._predicted = predicted
        is_long = (self._run >= np.maximum(STUCK, LONGER * self._usual)) & (self._moved >= STUCK)
        has_moved = np.abs(predicted - self._start) > MOVED * error
        self._is_stuck = repeats & (self._is_stuck | (is_long & has_moved & (self._calm >= CALM_BLOCKS)))
