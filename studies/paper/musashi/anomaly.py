"""Detection of a cut muscle, with and without a heavy object in the hand."""

from collections.abc import Mapping, Sequence

import numpy as np

from gemuco.anomaly import window
from gemuco.anomaly.healthy import learn_normal
from gemuco.dataset import Dataset, Episode
from gemuco.normal.windows import area
from gemuco.schema import BodySchema
from studies.paper.musashi.model import arrays
from studies.paper.musashi.motion import RATE

CUT_AFTER = 1.0
"""Time after the begin of a recording at which a muscle is cut [s]."""
SETTLED = 1.0
"""Time after the cut from which samples count as those of a cut muscle [s]."""


def with_normal(schema: BodySchema, recording: Dataset) -> BodySchema:
    """Return the schema with the normal errors of a healthy, unloaded arm."""
    return schema.with_normal(learn_normal(schema, schema.layout.join(arrays(recording, schema))))


def scores(schema: BodySchema, recording: Dataset) -> np.ndarray:
    """Return the score of every sample, shape (n,)."""
    if schema.normal is None:
        raise ValueError("This schema has no normal errors. Call `with_normal` first.")
    return window.scores(schema, schema.normalise(arrays(recording, schema)))


def since_cut(recording: Dataset) -> Dataset:
    """Return the part of a recording that begins a second after the cut."""
    first = round((CUT_AFTER + SETTLED) * RATE)
    episode = recording.episodes[0]
    kept = {name: values[first:] for name, values in episode.values.items()}
    return Dataset(recording.layout, (Episode(episode.condition, kept),))


def areas(
    schema: BodySchema, healthy: Sequence[Dataset], cut: Mapping[str, Dataset], over: float = 0.0
) -> dict[str, float]:
    """Return muscle -> area under the ROC curve of its scores against those of all healthy recordings.

    Args:
        schema: A schema with normal errors.
        healthy: Recordings of whole arms.
        cut: Muscle -> recording after its cut.
        over: Time over which scores are averaged [s]; 0 judges every sample alone.
    """
    weights = np.ones(max(1, round(over * RATE)))
    weights /= weights.sum()

    def held(recording: Dataset) -> np.ndarray:
        return np.convolve(scores(schema, recording), weights, "valid")

    well = np.concatenate([held(recording) for recording in healthy])
    return {muscle: area(held(recording), well) for muscle, recording in cut.items()}
