"""Errors of values that are not all of one time: stamps are rounded, and delays vary.

An arm at 2 rad/s moves by 0.01 rad in 5 ms, which is several errors of a good model. Such errors grow with the velocity
and are zero at rest, so they are no sign of a lie, and no size that was learned at rest or in slow motion has them.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from gemuco.trust.config import BLOCK

TIMING = 0.005
"""Values of two signals that count as of one time are apart by a multiple of this time [s], which is learned."""


class Shift(NamedTuple):
    """Changes of blocks if all elements of one signal are late by `TIMING`, for every signal.

    Attributes:
        values: Changes of every column [standard deviations], shape (n, signals, columns).
        features: Changes of the features of the watch, shape (n, signals, features).
    """

    values: np.ndarray
    features: np.ndarray

    @classmethod
    def joined(cls, parts: Iterable["Shift"]) -> "Shift":
        """Return parts one after the other."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def changes(rows: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Return how far all elements of each signal move within `TIMING`, shape (signals, columns).

    The largest step from one sample to the next does not count: a value that jumps does not excuse itself.

    Args:
        rows: Successive samples of one block, from the last one of the block before on, shape (samples, columns).
        signals: Number of the signal of each column, shape (columns,); negative for p.
    """
    owns = signals == np.unique(signals[signals >= 0])[:, None]
    steps = np.nan_to_num(np.diff(rows, axis=0))
    if len(steps) < 2:
        return np.zeros(owns.shape)
    largest = np.take_along_axis(steps, np.abs(steps).argmax(axis=0)[None], axis=0)[0]
    velocity = (steps.sum(axis=0) - largest) / ((len(steps) - 1) / len(steps) * BLOCK)
    return np.asarray(owns * velocity * TIMING)
