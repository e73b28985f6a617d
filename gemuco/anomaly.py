"""Anomaly detection (paper, II-K): the Mahalanobis distance of the prediction error, and which element is to blame."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gemuco.blame import suspects
from gemuco.compiled.score import errors
from gemuco.normal import Normal, judging_masks, prediction_errors

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

__all__ = ["AnomalyScore", "Normal", "judging_masks", "prediction_error", "score"]


@dataclass(frozen=True, slots=True)
class AnomalyScore:
    """How unlike normal one sample is.

    Attributes:
        score: Mahalanobis distance; NaN without normal data or without any error to judge.
        threshold: Score above which it counts as an anomaly.
        contribution: Signal of x_out -> by how much score^2 drops without an element, shape (n,); NaN if unknown.
        blamed: `signal.element` that is most likely wrong if the score is above the threshold (a window of samples
            tells better: `gemuco.blame`), else the one that contributes most; empty if the score is NaN.
    """

    score: float
    threshold: float
    contribution: dict[str, np.ndarray]
    blamed: str

    @property
    def is_anomaly(self) -> bool:
        """Whether this single sample is above the threshold."""
        return bool(self.score > self.threshold)


def prediction_error(schema: "BodySchema", values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Measured minus predicted [unit]; see `BodySchema.predict_error`."""
    return prediction_errors(schema, schema.normalise(values))


def score(schema: "BodySchema", values: Mapping[str, np.ndarray], blame: bool = True) -> AnomalyScore:
    """How unlike normal a sample is; see `BodySchema.anomaly`.

    Args:
        schema: With statistics of the normal.
        values: Signal -> measured array [its unit], shape (n,).
        blame: Whether to find what is most likely wrong, which costs many times the score; else the element that
            contributes most is named.
    """
    joined = schema.layout.join_one(values)
    joined[np.isinf(joined)] = np.nan
    if schema.normal is None:
        unknown = np.full(schema.out_layout.size, np.nan)
        return AnomalyScore(float("nan"), float("nan"), schema.out_layout.split(unknown), "")
    distance, contribution, judged = schema.normal.distance(errors(schema.ready.predictor, schema.ready.judges, joined))
    threshold = float(schema.normal.threshold_of(judged))
    blamed = ""
    if blame and distance > threshold:
        blamed = suspects(schema, schema.scaler.normalise(joined)[None])[0].name
    elif judged:
        blamed = schema.out_layout.element(int(np.fmax(contribution, -1.0).argmax()))
    return AnomalyScore(distance, threshold, schema.out_layout.split(contribution), blamed)
