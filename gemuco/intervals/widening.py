"""Widening of intervals by the errors that are seen (adaptive conformal prediction).

A signal that is measured can be predicted too: the error of its prediction says how wide the interval should have been.
The factor of an element rises after a miss and falls a little after a hit, so that in the long run 90 % are hits,
whatever the errors are. Each error is compared with the interval that was promised for it, also if the truth comes
late.
"""

import numpy as np

from gemuco.certainty.certainty import NINETY

SHARE = 0.905
"""This share of the errors shall be within the interval; a little more than 90 %, because late truth costs some."""
STEP = 0.5
"""The logarithm of a factor rises by this times `SHARE` after a miss, and falls by the rest of it after a hit."""
PATIENCE = 20.0
"""With truth this many samples late the step is half as large: misses of that time are already on their way."""
LEAST, MOST = 0.2, 1e3
"""A factor stays between these bounds."""

MEMORY = 600
"""This many of the newest errors of every element count."""
LOST_SHARE = 0.93
"""This share of them is within the interval of a signal that is then lost: it moves on to postures not seen lately."""
FIRST = 20
"""The errors of the training count as this many."""
NARROWEST = 0.5
"""The std of a lost signal is at least this share of the one from training."""


class Widening:
    """A factor on the std of every element.

    Args:
        size: Number of elements.
        step: See `STEP`.
        least: The factors are at least this.

    Attributes:
        factor: Present factors, shape (size,).
        seen: Number of errors seen of every element, shape (size,).
    """

    def __init__(self, size: int, step: float = STEP, least: float = LEAST) -> None:
        self.factor, self.seen = np.ones(size), np.zeros(size, int)
        self._step, self._least = step, least

    def see(self, missed: np.ndarray, std: np.ndarray, late: float = 0.0) -> None:
        """Take the errors of one sample.

        Args:
            missed: Truth minus estimate [unit of each element], shape (size,); NaN where the truth is not known.
            std: The std that was promised, with the factor of that time [the same units], shape (size,).
            late: Number of samples that were estimated since.
        """
        known = np.isfinite(missed) & np.isfinite(std)
        is_miss = np.abs(missed[known]) > NINETY * std[known]
        step = self._step / (1.0 + late / PATIENCE)
        moved = self.factor[known] * np.exp(step * (is_miss - (1.0 - SHARE)))
        self.factor[known] = np.clip(moved, self._least, MOST)
        self.seen[known] += 1

    def forget(self) -> None:
        """Begin anew, as after a change of the body."""
        self.factor[:] = 1.0
        self.seen[:] = 0


class RecentErrors:
    """A factor on the std of every element of a signal that is lost: the quantile of its errors while it was measured.

    `Widening` follows the errors of the moment, which is right while truth comes late. A lost signal moves on, so all
    recent errors count.

    Args:
        size: Number of elements.

    Attributes:
        factor: Present factors, shape (size,); never written to again.
    """

    def __init__(self, size: int) -> None:
        normal = np.abs(np.random.default_rng(0).standard_normal(100 * FIRST))
        first = np.quantile(normal, (np.arange(FIRST) + 0.5) / FIRST) / NINETY
        self._ratios = np.full((size, FIRST + MEMORY), np.nan)
        self._ratios[:, :FIRST] = first
        self._count = np.zeros(size, int)
        self.factor = np.ones(size)

    def see(self, missed: np.ndarray, std: np.ndarray) -> None:
        """Take the errors of one sample.

        Args:
            missed: Truth minus estimate [unit of each element], shape (size,); NaN where the truth is not known.
            std: The std of the estimates, without a factor [the same units], shape (size,).
        """
        known = np.flatnonzero(np.isfinite(missed) & np.isfinite(std) & (std > 0.0))
        self._ratios[known, FIRST + self._count[known] % MEMORY] = np.abs(missed[known]) / (NINETY * std[known])
        self._count[known] += 1
        ordered = np.sort(self._ratios[known], axis=1)  # NaN come last
        place = LOST_SHARE * (FIRST + np.minimum(self._count[known], MEMORY) - 1)
        factor = self.factor.copy()
        factor[known] = np.clip(ordered[np.arange(len(known)), np.ceil(place).astype(int)], NARROWEST, MOST)
        self.factor = factor

    def forget(self) -> None:
        """Begin anew, as after a change of the body."""
        self._ratios[:, FIRST:] = np.nan
        self._count[:] = 0
        self.factor = np.ones(len(self.factor))
