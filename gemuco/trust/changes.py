"""Tests of errors that follow each other: a change at an unknown moment, and a small deviation that lasts.

Neighbouring errors of a healthy body are alike, because the error of a model depends on the posture. A test that takes
them as independent alarms at every slow motion. So the errors count as a slow part that forgets, and white noise.
"""

from dataclasses import dataclass

import numpy as np

AGES = (1, 2, 3, 5, 8, 12, 20, 30)
"""A change may be this number of blocks old."""
LONGEST = AGES[-1]
"""A test looks at this number of the newest blocks."""
MOST = 6.0
"""One independent look adds at most this much to the sum: a healthy body is far off now and then, at a rare posture."""


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
        self._weights: dict[bytes, np.ndarray] = {}

    def __call__(self, z: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest deviation over all ages [standard deviations], and its index into `AGES`, shapes (n,).

        Args:
            z: The newest errors [their standard deviations], oldest first, shape (LONGEST, n); NaN where missing.
            moved: Motion of the body up to each of them [blocks of motion at the usual pace], shape (LONGEST,).
        """
        known = np.isfinite(z)
        each = np.zeros((z.shape[1], len(AGES)))
        for pattern in np.unique(known, axis=1).T:
            own = (known == pattern[:, None]).all(axis=0)
            both = [
                np.abs(np.einsum("nab,bn->na", self._weights_of(pattern, places)[own], z[:, own][pattern]))
                for places in (np.arange(LONGEST, dtype=float), moved)
            ]
            each[own] = np.minimum(*both)
        best = each.argmax(axis=1)
        return each[np.arange(len(best)), best], best

    def _weights_of(self, known: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return the deviations by the known errors, shape (n, ages, number of known ones)."""
        key = known.tobytes() + places.tobytes()
        weights = self._weights.get(key)
        if weights is None:
            steps, precisions = self._steps[:, known], np.linalg.inv(self._likeness.covariances(places[known]))
            scaled = np.einsum("ab,nbc->nac", steps, precisions)
            information = np.einsum("nac,ac->na", scaled, steps)
            weights = self._weights[key] = scaled / np.sqrt(np.maximum(information, 1e-12))[..., None]
        return weights


class LastingTest:
    """Cumulative sum: how likely it is that an element has been off, one way, by at least the size that matters.

    A robot at rest shows the same error again and again, so the sum grows with motion and not with time.
    """

    def __init__(self, size: int) -> None:
        self.sums = np.zeros((2, size))

    def add(self, z: np.ndarray, least: np.ndarray, looks: np.ndarray) -> None:
        """Add one block.

        Args:
            z: Errors [their standard deviations], shape (n,); NaN where missing.
            least: Size that matters [their standard deviations], shape (n,).
            looks: Number of independent looks that this block is worth, at most 1, shape (n,).
        """
        for row, sign in enumerate((1.0, -1.0)):
            gain = np.clip(least * np.nan_to_num(sign * z) - 0.5 * least**2, -MOST, MOST) * looks
            self.sums[row] = np.maximum(0.0, self.sums[row] + gain)

    @property
    def likelihood(self) -> np.ndarray:
        """Logarithm of the likelihood ratio, shape (n,)."""
        return np.asarray(self.sums.max(axis=0))
