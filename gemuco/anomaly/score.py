"""Anomaly detection (paper, II-K): the Mahalanobis distance of the prediction error, and its most likely cause."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.anomaly.blame import suspects
from gemuco.anomaly.prediction import judgements, judges
from gemuco.compiled import score as compiled
from gemuco.schema import BodySchema, check_schema


@dataclass(frozen=True, slots=True)
class AnomalyScore:
    """Distance of one sample from the normal.

    Attributes:
        score: Mahalanobis distance; NaN without statistics of prediction errors or without any error to judge.
        threshold: Score above which a sample is an anomaly.
        contribution: Signal -> drop of the squared distance without the error of an element that contributes most,
            shape (n,); NaN where no error is judged.
        blamed: `signal.element` that is most likely wrong if the score is above the threshold (a window of samples is
            more reliable: `judge`), else the one that contributes most; empty if the score is NaN.
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
    """Return the distance of a sample from the normal (paper, II-K).

    Args:
        schema: A schema with statistics of prediction errors.
        values: Signal -> measured array [its unit], shape (n,).
        blame: Whether to search the element that is most likely wrong, which takes many times as long as the score;
            else the one that contributes most is named.
    """
    check_schema(schema)
    joined = schema.layout.join_one(values)
    joined.setflags(write=False)
    deviation = deviation_of(schema, joined)
    blamed = deviation.largest(schema)
    if blame and deviation.distance > deviation.threshold:
        blamed = suspects(schema, schema.normalise_one(values)[None])[0].name
    contribution = schema.layout.split(deviation.contribution)
    return AnomalyScore(deviation.distance, deviation.threshold, contribution, blamed)


@dataclass(frozen=True, slots=True)
class Deviation:
    """Distance of one sample from the normal, without a cause; see `AnomalyScore`.

    Attributes:
        distance: Mahalanobis distance.
        threshold: Distance above which a sample is an anomaly.
        contribution: Contribution of every element, shape (size,).
    """

    distance: float
    threshold: float
    contribution: np.ndarray

    def largest(self, schema: BodySchema) -> str:
        """Return the `signal.element` that contributes most; empty if no element was judged."""
        if np.isnan(self.distance):
            return ""
        return schema.layout.element(int(np.fmax(self.contribution, -1.0).argmax()))


def deviation_of(schema: BodySchema, joined: np.ndarray) -> Deviation:
    """Return the deviation of a sample in one read-only array, as `gemuco.estimation.fill` takes it."""
    by = schema.derived(judgements)(np.isfinite(joined))
    if not len(by.judged.place):
        return Deviation(float("nan"), float("nan"), np.full(schema.layout.size, np.nan))
    predictor = schema.predictor
    network = compiled.errors(predictor, schema.derived(judges), joined)
    distance, contribution = compiled.deviation(network, joined, schema.bias, predictor.scale, *by.parts)
    return Deviation(distance, by.threshold, contribution)
