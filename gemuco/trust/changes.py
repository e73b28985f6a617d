"""Tests of errors that follow each other: a change at an unknown moment, and a small deviation that lasts.

Neighbouring errors of a healthy body are alike, because the error of a model depends on the posture. A test that takes
them as independent alarms at every slow motion. So the errors count as a slow part that forgets, and white noise.
"""

from dataclasses import dataclass

import numpy as np

FAINT = 2.0
"""Below this deviation [standard deviations] the smaller of the step test's two is not computed: it is no evidence."""
AGES = (1, 2, 3, 5, 8, 12, 20, 30)
"""A change may be this number of blocks old."""
LONGEST = AGES[-1]
"""A test looks at this number of the newest blocks."""
MOST = 6.0
"""One independent look adds at most this much to the sum: a healthy body is far off now and then, at a rare posture."""
FURTHEST = 2.0
"""A prediction counts as at most this far from the mean of its signal [standard deviations]."""


@dataclass(frozen=True, slots=True, eq=False)
class Likeness:
    """Likeness of neighbouring errors of every element.

    Attributes:
        slow: Correlation of the slow part from block to block, shape (n,).
        white: Share of the variance that is white noise, shape (n,).
    """

    slow: np.ndarray
    white: np.ndarray

    @classmethod
    def of(cls, near: np.ndarray, far: np.ndarray, apart: int) -> "Likeness":
        """Return the likeness from correlations at a distance of one block and of `apart` blocks, shapes (n,)."""
        near, far = np.clip(near, 0.02, 0.985), np.clip(far, 0.01, 0.97)
        slow = np.clip((far / near) ** (1.0 / (apart - 1)), 0.3, 0.97)
        return cls(slow, np.clip(1.0 - near / slow, 0.02, 0.98))

    def of_columns(self, columns: np.ndarray) -> "Likeness":
        """Return the likeness of some columns."""
        return Likeness(self.slow[columns], self.white[columns])

    @property
    def time(self) -> np.ndarray:
        """Number of blocks that are worth one independent block, shape (n,)."""
        return 1.0 + (1.0 - self.white) * 2.0 * self.slow / (1.0 - self.slow)

    def covariances(self, places: np.ndarray) -> np.ndarray:
        """Return the covariances of errors of variance 1 at some places [blocks], shape (m,): (n, m, m)."""
        lag = np.abs(np.subtract.outer(places, places))
        slow = (1.0 - self.white)[:, None, None] * self.slow[:, None, None] ** lag
        return np.asarray(slow + self.white[:, None, None] * np.eye(len(places)))


class StepTest:
    """Likelihood ratio of a step of any size and one of several ages against no step, for every element.

    A missing error may have been any: the first one after a gap is no step because it is not zero. And errors at one
    posture say the same again and again. So two deviations are computed, with errors that forget in time and with
    errors that forget in motion only, and the smaller one counts.
    """

    def __init__(self, likeness: Likeness) -> None:
        self._likeness = likeness
        self._steps = (np.arange(LONGEST)[None, :] >= LONGEST - np.array(AGES)[:, None]).astype(float)
        self._weights: dict[tuple[bytes, bytes], np.ndarray] = {}

    def __call__(self, z: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest deviation over all ages [standard deviations], and its index into `AGES`, shapes (n,).

        Args:
            z: The newest errors [their standard deviations], oldest first, shape (LONGEST, n); NaN where missing.
            moved: Motion of the body up to each of them [blocks of motion at the usual pace], shape (LONGEST,).
        """
        known = np.isfinite(z)
        each = np.zeros((z.shape[1], len(AGES)))
        patterns = known[:, :1].T if (known == known[:, :1]).all() else np.unique(known, axis=1).T
        for pattern in patterns:
            own = np.flatnonzero((known == pattern[:, None]).all(axis=0))
            each[own] = self._deviations(z, own, pattern, np.arange(LONGEST, dtype=float))
            large = own[each[own].max(axis=1) >= FAINT]
            each[large] = np.minimum(each[large], self._deviations(z, large, pattern, moved))
        best = each.argmax(axis=1)
        return each[np.arange(len(best)), best], best

    def _deviations(self, z: np.ndarray, columns: np.ndarray, known: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return the deviations of some columns by their known errors at these places, shape (columns, ages)."""
        weights = self._weights_of(columns, known, places)
        return np.abs(np.einsum("nab,bn->na", weights, z[:, columns][known]))

    def _weights_of(self, columns: np.ndarray, known: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return the weights of the known errors in the deviations of some columns, shape (columns, ages, known)."""
        size, key = len(self._likeness.slow), (known.tobytes(), places.tobytes())
        if key not in self._weights:
            self._weights[key] = np.full((size, len(AGES), int(known.sum())), np.nan)
        weights = self._weights[key]
        fresh = columns[np.isnan(weights[columns]).all(axis=(1, 2))]
        if len(fresh):
            steps, likeness = self._steps[:, known], self._likeness.of_columns(fresh)
            scaled = np.einsum("ab,nbc->nac", steps, np.linalg.inv(likeness.covariances(places[known])))
            information = np.einsum("nac,ac->na", scaled, steps)
            weights[fresh] = scaled / np.sqrt(np.maximum(information, 1e-12))[..., None]
        return weights[columns]


class LastingTest:
    """Cumulative sums: how likely it is that an element has been off by at least the size that matters.

    Either it has been off one way, or in proportion to its prediction: errors of a wrong gain or sign change their sign
    with it. A robot at rest shows the same error again and again, so the sums grow with motion and not with time.
    """

    def __init__(self, size: int) -> None:
        self.sums = np.zeros((4, size))

    def add(self, z: np.ndarray, predicted: np.ndarray, least: np.ndarray, looks: np.ndarray) -> None:
        """Add one block.

        Args:
            z: Errors [their standard deviations], shape (n,); NaN where missing.
            predicted: Predictions of the others [standard deviations of the signal], shape (n,); NaN where missing.
            least: Size that matters [their standard deviations], shape (n,).
            looks: Number of independent looks that this block is worth, at most 1, shape (n,).
        """
        line = np.clip(np.nan_to_num(predicted), -FURTHEST, FURTHEST)
        ways = np.stack([np.ones(len(z)), -np.ones(len(z)), line, -line]) * least
        gain = np.clip(ways * np.nan_to_num(z) - 0.5 * ways**2, -MOST, MOST) * looks
        self.sums = np.maximum(0.0, self.sums + gain)

    @property
    def likelihood(self) -> np.ndarray:
        """Logarithm of the likelihood ratio, shape (n,)."""
        return np.asarray(self.sums.max(axis=0))
