"""Anomaly detection (paper, II-K): the Mahalanobis distance of the prediction error, and which element is to blame."""

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from gemuco.errors import NotEnoughData
from gemuco.estimate import mask_error
from gemuco.masks import Mask

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

SHRINK = 0.05
"""Share of the covariance that is replaced by its diagonal, so that a few samples cannot make it singular."""

FLOOR = 0.01
"""Smallest standard deviation of an error, as a share of the signal's own standard deviation."""

HELD_OUT = 0.3
"""Share of the normal data, its end, that sets the threshold and is not used for mean and covariance."""

SUSPECTS = 6
"""How many of the largest contributors are repaired in turn to find the one to blame."""


@dataclass(frozen=True, slots=True)
class AnomalyScore:
    """How unlike normal one sample is.

    Attributes:
        score: Mahalanobis distance; NaN without normal data or without any error to judge.
        threshold: Score above which it counts as an anomaly.
        contribution: Signal of x_out -> by how much score^2 drops without an element, shape (n,); NaN if unknown.
        blamed: `signal.element` whose repair would make the sample most normal; empty if the score is NaN.
    """

    score: float
    threshold: float
    contribution: dict[str, np.ndarray]
    blamed: str

    @property
    def is_anomaly(self) -> bool:
        """Whether this single sample is above the threshold."""
        return bool(self.score > self.threshold)


@dataclass(frozen=True, slots=True)
class Normal:
    """What prediction errors are like on a healthy body.

    Attributes:
        mean: Mean error [unit], shape (out_size,); NaN where errors were never seen.
        covariance: Regularised covariance [unit^2], shape (out_size, out_size).
        threshold: Score that a healthy body exceeds with the wanted false alarm rate.
        false_alarm: That rate, per sample.
    """

    mean: np.ndarray
    covariance: np.ndarray
    threshold: float
    false_alarm: float

    @classmethod
    def fit(cls, errors: np.ndarray, spread: np.ndarray, false_alarm: float = 1e-3) -> "Normal":
        """Learn from errors of a healthy body, oldest first.

        Args:
            errors: Prediction errors [unit], shape (samples, out_size), NaN where one was not to be had.
            spread: Standard deviation of every x_out element itself [unit], shape (out_size,).
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
        """Distance of one error [unit], shape (out_size,), judged by the elements that are there.

        Returns:
            The Mahalanobis distance, each element's contribution to its square (the drop of the square when that
            element alone is left out: (P e)_i^2 / P_ii), and how many elements were judged.
        """
        index, precision = self._precision(error)
        contribution = np.full(len(error), np.nan)
        if not len(index):
            return float("nan"), contribution, 0
        e = error[index] - self.mean[index]
        weighted = precision @ e
        contribution[index] = weighted**2 / np.diag(precision)
        return float(np.sqrt(max(0.0, float(e @ weighted)))), contribution, len(index)

    def distances(self, errors: np.ndarray) -> np.ndarray:
        """Distances of errors that lack the same elements, shape (samples, out_size) -> (samples,)."""
        index, precision = self._precision(errors[0])
        e = errors[:, index] - self.mean[index]
        return np.sqrt(np.einsum("ij,jk,ik->i", e, precision, e).clip(min=0.0))

    def _precision(self, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which elements of an error are there, and the inverse covariance of those."""
        index = np.flatnonzero(np.isfinite(error) & np.isfinite(self.mean))
        return index, np.linalg.inv(self.covariance[np.ix_(index, index)])


def _tail(scores: np.ndarray, false_alarm: float) -> float:
    """The score that is exceeded with a small probability: observed where there is data, else by a log-normal tail."""
    logs = np.log(np.maximum(scores, 1e-9))
    z = NormalDist().inv_cdf(1.0 - false_alarm)
    return max(float(np.quantile(scores, 1.0 - false_alarm)), float(np.exp(logs.mean() + z * logs.std())))


def judging_masks(schema: "BodySchema") -> dict[str, Mask]:
    """Which mask predicts each signal of x_out for the sake of anomaly detection.

    A mask without the signal itself where there is one, since a signal explains itself even when it is wrong.
    """
    chosen: dict[str, Mask] = {}
    for name in schema.x_out:
        blind = [mask for mask in schema.masks if name not in mask]
        chosen[name] = min(blind or schema.masks, key=lambda m: mask_error(schema, m, name))
    return chosen


def prediction_error(schema: "BodySchema", values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Measured minus predicted [unit]; see `BodySchema.predict_error`.

    An element's error is NaN when it was not measured or when the mask that judges its signal lacks a value: another
    mask would make errors of another size, which the statistics of the normal do not describe.
    """
    return _error(schema, schema.normalise(values))


def _error(schema: "BodySchema", x: np.ndarray) -> np.ndarray:
    """The error [unit], shape (..., out_size), of samples [standard deviations], shape (..., size)."""
    error = np.full((*x.shape[:-1], schema.out_layout.size), np.nan)
    predicted: dict[Mask, np.ndarray] = {}
    for name, mask in schema.judges.items():
        if mask not in predicted:
            prediction = schema.infer(x, mask).astype(float)
            prediction[~np.isfinite(x[..., schema.layout.indices(mask)]).all(axis=-1)] = np.nan
            predicted[mask] = prediction
        span, out = schema.layout.slice(name), schema.out_layout.slice(name)
        error[..., out] = (x[..., span] - predicted[mask][..., out]) * schema.scaler.std[span]
    return error


def score(schema: "BodySchema", values: Mapping[str, np.ndarray]) -> AnomalyScore:
    """How unlike normal a sample is; see `BodySchema.score`."""
    x = schema.normalise(values)
    if schema.normal is None:
        unknown = np.full(schema.out_layout.size, np.nan)
        return AnomalyScore(float("nan"), float("nan"), schema.out_layout.split(unknown), "")
    error = _error(schema, x)
    distance, contribution, judged = schema.normal.distance(error)
    # The square of the distance grows with the number of judged elements, so the threshold follows it.
    usual = int(np.isfinite(schema.normal.mean).sum())
    threshold = schema.normal.threshold * float(np.sqrt(judged / usual)) if judged else float("nan")
    blamed = ""
    if distance > threshold:  # repairs cost more than the score itself
        blamed = _blamed(schema, x, error, contribution)
    elif judged:
        blamed = schema.out_layout.element(int(np.nanargmax(contribution)))
    return AnomalyScore(distance, threshold, schema.out_layout.split(contribution), blamed)


def _blamed(schema: "BodySchema", x: np.ndarray, error: np.ndarray, contribution: np.ndarray) -> str:
    """The element whose repair makes the sample most normal.

    One wrong element upsets every prediction that is made from it: a muscle that was cut makes the joints look wrong
    too. So each of the largest contributors is replaced by its prediction in turn, and everything is judged anew.
    Elements that nothing predicts but themselves cannot be repaired; without others the largest contributor is blamed.
    """
    normal = schema.normal
    assert normal is not None
    blind = np.concatenate(
        [np.full(schema.layout.signal(name).size, name not in mask) for name, mask in schema.judges.items()]
    )
    known = np.where(blind & np.isfinite(contribution), contribution, -1.0)
    suspects = np.argsort(known)[: -SUSPECTS - 1 : -1]
    suspects = suspects[known[suspects] >= 0.0]
    if not len(suspects):
        return schema.out_layout.element(int(np.nanargmax(contribution)))
    repaired = np.repeat(x[None], len(suspects), axis=0)
    where = schema.out_index[suspects]
    repaired[np.arange(len(suspects)), where] -= error[suspects] / schema.scaler.std[where]
    distances = normal.distances(_error(schema, repaired))
    return schema.out_layout.element(int(suspects[int(np.argmin(distances))]))
