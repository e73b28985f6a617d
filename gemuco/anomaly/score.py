"""Anomaly detection (paper, II-K): the Mahalanobis distance of the prediction error, and which element is to blame."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.anomaly.blame import suspects
from gemuco.anomaly.prediction import judgements, judges
from gemuco.compiled.score import deviation
from gemuco.schema import BodySchema, check_schema


@dataclass(frozen=True, slots=True)
class AnomalyScore:
    """How unlike normal one sample is.

    Attributes:
        score: Mahalanobis distance; NaN without normal data or without any error to judge.
        threshold: Score above which it counts as an anomaly.
        contribution: Signal of x_out -> by how much score^2 drops without an element, shape (n,); NaN if unknown.
        blamed: `signal.element` that is most likely wrong if the score is above the threshold (a window of samples
            tells better: `gemuco.anomaly.blame`), else the one that contributes most; empty if the score is NaN.
    """

    score: float
    threshold: float
    contribution: dict[str, np.ndarray]
    blamed: str

    @property
    def is_anomaly(self) -> bool:
        """Whether this single sample is above the threshold."""
        return bool(self.score > self.threshold)


def score(schema: BodySchema, values: Mapping[str, np.ndarray], blame: bool = True) -> AnomalyScore:
    """Score how unlike normal a sample is (paper, II-K).

    Args:
        schema: With statistics of the normal.
        values: Signal -> measured array [its unit], shape (n,).
        blame: Whether to find what is most likely wrong, which costs many times the score; else the element that
            contributes most is named.
    """
    check_schema(schema)
    joined = schema.layout.join_one(values)
    joined.setflags(write=False)
    found = judged(schema, joined)
    blamed = found.blamed(schema)
    if blame and found.distance > found.threshold:
        blamed = suspects(schema, schema.normalise_one(values)[None])[0].name
    return AnomalyScore(found.distance, found.threshold, schema.out_layout.split(found.contribution), blamed)


@dataclass(frozen=True, slots=True)
class Judged:
    """The score of a sample; see `AnomalyScore`.

    Attributes:
        distance: Mahalanobis distance.
        threshold: Above which it counts as an anomaly.
        contribution: Of every element of x_out, shape (out_size,).
    """

    distance: float
    threshold: float
    contribution: np.ndarray

    def blamed(self, schema: BodySchema) -> str:
        """`signal.element` that contributes most; empty if nothing was judged."""
        if np.isnan(self.distance):
            return ""
        return schema.out_layout.element(int(np.fmax(self.contribution, -1.0).argmax()))


def judged(schema: BodySchema, joined: np.ndarray) -> Judged:
    """The score of a sample in one array, as `estimate.fill` takes it."""
    by = schema.derived(judgements)(np.isfinite(joined))
    if schema.normal is None or not len(by.index):
        return Judged(float("nan"), float("nan"), np.full(schema.out_layout.size, np.nan))
    distance, contribution = deviation(
        schema.predictor, schema.derived(judges), joined, schema.normal.mean, by.index, by.precision
    )
    return Judged(distance, by.threshold, contribution)
