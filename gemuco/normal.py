"""Statistics of the prediction errors of a healthy body: mean, covariance and threshold (paper, II-K)."""

from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np

from gemuco.compiled import score
from gemuco.errors import NotEnoughData

SHRINK = 0.05
"""This share of the covariance is replaced by its diagonal, so that a few samples cannot make it singular."""

FLOOR = 0.01
"""The standard deviation of an error is at least this share of the signal's own standard deviation."""

PATTERNS = 64
"""At most this many inverse covariances are cached, one per set of judged elements."""

HELD_OUT = 0.3
"""The last part of the normal data, this share, sets the threshold and is not used for mean and covariance."""


@dataclass(frozen=True, slots=True)
class Normal:
    """Statistics of the prediction errors of a healthy body.

    Attributes:
        mean: Mean error [unit], shape (out_size,); NaN where no errors are known.
        covariance: Regularised covariance [unit^2], shape (out_size, out_size).
        threshold: A healthy body's score is above this with the probability `false_alarm`.
        false_alarm: Probability of a false alarm per sample.
        usual: Number of elements that are judged when none is missing.
    """

    mean: np.ndarray
    covariance: np.ndarray
    threshold: float
    false_alarm: float
    usual: int = field(init=False, repr=False)
    _precisions: dict[bytes, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "usual", int(np.isfinite(self.mean).sum()))

    @classmethod
    def fit(cls, errors: np.ndarray, spread: np.ndarray, false_alarm: float = 1e-3) -> "Normal":
        """Compute the statistics of a healthy body.

        Args:
            errors: Prediction errors [unit], oldest first, shape (samples, out_size), NaN where unknown.
            spread: Standard deviation of every x_out element [unit], shape (out_size,).
            false_alarm: Share of healthy samples that may lie above the threshold.

        Raises:
            NotEnoughData: Fewer complete samples than three per element.
        """
        seen = np.isfinite(errors).mean(axis=0) > 0.5
        rows = errors[np.isfinite(errors[:, seen]).all(axis=1)][:, seen]
        if not seen.any() or len(rows) < 3 * seen.sum():
            raise NotEnoughData(
                f"Normal statistics of {int(seen.sum())} elements need {int(3 * max(1, seen.sum()))} complete samples; "
                f"there are {len(rows)}."
            )
        count = len(rows) - int(HELD_OUT * len(rows))
        part = np.cov(rows[:count].T).reshape(int(seen.sum()), -1)
        part = (1.0 - SHRINK) * part + np.diag(SHRINK * np.diag(part) + (FLOOR * spread[seen]) ** 2)
        mean = np.full(len(seen), np.nan)
        mean[seen] = rows[:count].mean(axis=0)
        covariance = np.diag(spread**2)
        covariance[np.ix_(seen, seen)] = part
        draft = cls(mean, covariance, float("nan"), false_alarm)
        judged = np.full((len(rows) - count, len(seen)), np.nan)
        judged[:, seen] = rows[count:]
        scores = draft.distances(judged)
        return cls(mean, covariance, _tail(scores, false_alarm), false_alarm)

    def distance(self, error: np.ndarray) -> tuple[float, np.ndarray, int]:
        """Return the distance of one error [unit], shape (out_size,), judged by its finite elements.

        Returns:
            The Mahalanobis distance, the contribution of each element (the decrease of the squared distance without
            this element: (P e)_i^2 / P_ii), and the number of judged elements.
        """
        index, precision = self.precision(np.isfinite(error - self.mean))
        if not len(index):
            return float("nan"), np.full(len(error), np.nan), 0
        distance, contribution = score.distance(error, self.mean, index, precision)
        return distance, contribution, len(index)

    def distances(self, errors: np.ndarray) -> np.ndarray:
        """Return the distances of errors that lack the same elements, shape (samples, out_size) -> (samples,)."""
        index, precision = self.precision(np.isfinite(errors[0] - self.mean))
        e = errors[:, index] - self.mean[index]
        return np.sqrt(np.einsum("ij,jk,ik->i", e, precision, e).clip(min=0.0))

    def threshold_of(self, judged: int | np.ndarray) -> np.ndarray:
        """Return the threshold for a number of judged elements; its square is proportional to this number.

        Args:
            judged: Number of judged elements, a scalar or of shape (samples,).

        Returns:
            The threshold; NaN where no element is judged.
        """
        share = np.asarray(judged, float) / self.usual
        return np.where(share > 0.0, self.threshold * np.sqrt(share), np.nan)

    def precision(self, judged: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of the judged elements, shape (n,), and the inverse of their covariance, shape (n, n).

        Args:
            judged: Truth values, shape (out_size,); an element needs a known error and a known mean.
        """
        precision = self._precisions.get(judged.tobytes())
        if precision is None:
            index = np.flatnonzero(judged)
            precision = index, np.linalg.inv(self.covariance[np.ix_(index, index)])
            if len(self._precisions) >= PATTERNS:
                self._precisions.clear()
            self._precisions[judged.tobytes()] = precision
        return precision


def _tail(scores: np.ndarray, false_alarm: float) -> float:
    """Return the score that is exceeded with a small probability: the observed or the log-normal one, the larger."""
    logs = np.log(np.maximum(scores, 1e-9))
    z = NormalDist().inv_cdf(1.0 - false_alarm)
    return max(float(np.quantile(scores, 1.0 - false_alarm)), float(np.exp(logs.mean() + z * logs.std())))
