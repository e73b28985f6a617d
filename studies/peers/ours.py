"""The model of this project by its front door: trained once for all questions on a body, then asked each of them."""

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gemuco import BodySchema, SchemaError, estimate, fit, learn, score
from studies.peers.anomalies import Fault, Watched
from studies.peers.question import Body, Question, Rows, Trial


@dataclass(frozen=True, slots=True)
class Trained:
    """A trained model.

    Attributes:
        schema: The model; None if the data were refused.
        seconds: Duration of structure determination and training [s].
        refusal: The refusal in words, or empty.
    """

    schema: BodySchema | None
    seconds: float
    refusal: str = ""


def train(body: Body, trial: Trial, seed: int) -> Trained:
    """Train the model on a body."""
    data = {condition: [dict(episode) for episode in episodes] for condition, episodes in trial.train.items()}
    units: Mapping[str, str] = body.units
    begin = time.perf_counter()
    try:
        if body.masks is None:
            schema = learn(data, body.settings(seed), x_out=body.outputs, units=units)
        else:
            schema, _ = fit(data, body.settings(seed), body.masks, x_out=body.outputs, units=units)
    except SchemaError as error:
        return Trained(None, time.perf_counter() - begin, str(error))
    return Trained(schema, time.perf_counter() - begin)


def predict(trained: Trained, question: Question, trial: Trial) -> np.ndarray:
    """Return the estimates of the missing signal in all test rows [its unit], shape (n, size); NaN without one."""
    parts = []
    for condition, rows in trial.test.items():
        if trained.schema is None:
            parts.append(np.full(rows[question.target].shape, np.nan))
            continue
        schema = trained.schema.under(condition) if len(trial.train) > 1 else trained.schema
        known = set(schema.layout.names)
        given = {name: rows[name] for name in question.given if name in known}
        parts.append(np.asarray(estimate(schema, given)[question.target].value))
    return np.concatenate(parts)


def watch(fault: Fault, watched: Watched, seed: int) -> Trained:
    """Train the model on healthy rows; its structure is determined from them."""
    begin = time.perf_counter()
    try:
        schema = learn([dict(rows) for rows in watched.train], fault.settings(seed), units=fault.units)
    except SchemaError as error:
        return Trained(None, time.perf_counter() - begin, str(error))
    return Trained(schema, time.perf_counter() - begin)


def scores(trained: Trained, rows: Rows) -> np.ndarray:
    """Return the anomaly score of every row, shape (n,); NaN where nothing could be judged."""
    count = len(next(iter(rows.values())))
    if trained.schema is None:
        return np.full(count, np.nan)
    schema, names = trained.schema, trained.schema.layout.names
    samples = ({name: rows[name][index] for name in names} for index in range(count))
    return np.array([score(schema, sample, blame=False).score for sample in samples])
