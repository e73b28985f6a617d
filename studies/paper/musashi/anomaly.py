"""Is a cut muscle told from a healthy body, with and without a heavy object in the hand?"""

from collections.abc import Mapping, Sequence

import numpy as np

from gemuco.anomaly.prediction import predict_error
from gemuco.dataset import Dataset, Episode
from gemuco.normal import Normal
from gemuco.schema import BodySchema
from studies.paper.musashi.model import arrays
from studies.paper.musashi.motion import RATE

CUT_AFTER = 1.0
"""A muscle is cut so long after a recording began [s]."""
SETTLED = 1.0
"""Samples count as of a cut muscle so long after the cut [s]."""


def with_normal(schema: BodySchema, recording: Dataset) -> BodySchema:
    """The schema with what is normal learned from a healthy, unloaded arm."""
    errors = predict_error(schema, arrays(recording, schema))
    return schema.with_normal(Normal.fit(errors, schema.scaler.std[schema.out_index]))


def scores(schema: BodySchema, recording: Dataset) -> np.ndarray:
    """Mahalanobis distance of every sample, shape (n,)."""
    if schema.normal is None:
        raise ValueError("This schema has not learned what is normal; give it to `with_normal` first.")
    return schema.normal.distances(predict_error(schema, arrays(recording, schema)))


def area(ill: np.ndarray, well: np.ndarray) -> float:
    """Area under the ROC curve: how often a score of an ill body is higher than one of a healthy body."""
    ordered = np.sort(well)
    below = np.searchsorted(ordered, ill, side="left")
    not_above = np.searchsorted(ordered, ill, side="right")
    return float(np.mean(below + not_above) / (2.0 * len(ordered)))


def since_cut(recording: Dataset) -> Dataset:
    """What a recording with a cut muscle holds from a second after the cut."""
    first = round((CUT_AFTER + SETTLED) * RATE)
    episode = recording.episodes[0]
    kept = {name: values[first:] for name, values in episode.values.items()}
    return Dataset(recording.layout, (Episode(episode.condition, kept),))


def areas(
    schema: BodySchema, healthy: Sequence[Dataset], cut: Mapping[str, Dataset], over: float = 0.0
) -> dict[str, float]:
    """Muscle -> area under the ROC curve of the scores after its cut against those of all healthy recordings.

    Args:
        schema: With what is normal.
        healthy: Recordings of whole arms.
        cut: Muscle -> recording after its cut.
        over: Scores are averaged over so long before they are judged [s]; 0 judges every sample alone.
    """
    weights = np.ones(max(1, round(over * RATE)))
    weights /= weights.sum()

    def held(recording: Dataset) -> np.ndarray:
        return np.convolve(scores(schema, recording), weights, "valid")

    well = np.concatenate([held(recording) for recording in healthy])
    return {muscle: area(held(recording), well) for muscle, recording in cut.items()}
