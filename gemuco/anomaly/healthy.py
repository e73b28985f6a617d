"""Learning of what is normal: from training data, or anew from samples of the body as it is now (paper, II-K)."""

from dataclasses import replace

import numpy as np

from gemuco.anomaly import neighbours
from gemuco.anomaly.prediction import all_errors, with_bias
from gemuco.errors import NotEnoughData
from gemuco.normal import KEPT, LEAST, Normal, Scale
from gemuco.schema import BodySchema
from gemuco.signals import Layout
from gemuco.watch import NO_READING, Watch
from gemuco.windows import area

WEIGHTS = (0.0, 0.5, 1.0)
"""Weights of the distance from known samples that are compared."""

BETTER = 0.005
"""A larger weight must find imitated faults better by this area under the ROC curve."""

IMITATED = 600
"""Weights are compared on this number of normal samples and as many imitated faults of each kind."""


def learn_normal(
    schema: BodySchema,
    rows: np.ndarray,
    bias: np.ndarray | None = None,
    false_alarm: float = 1e-3,
    training: tuple[np.ndarray, np.ndarray] | None = None,
) -> Normal:
    """Learn the normal errors of a healthy body.

    Args:
        schema: The body schema. What its normal knows of the relations between the signals is used where it fits.
        rows: Samples that the network did not learn from [unit], oldest first, shape (n, size), NaN where not measured.
        bias: p of every sample, shape (n, bias_size); the schema's p if not given.
        false_alarm: Share of healthy samples that may lie above the threshold.
        training: Samples [unit] and their p for the watch. If not given, the watch is learned from `rows`, and each of
            its residuals from a watch that did not learn from this part of them.

    Raises:
        NotEnoughData: Too few complete samples.
    """
    x = with_bias(schema, schema.scaler.normalise(np.asarray(rows, float)), bias)
    signal = _columns(schema, x)
    whole = np.isfinite(x[:, signal >= -1]).all(axis=1)
    complete = x[whole]
    _check(complete)
    before = None if schema.normal is None else schema.normal.watch
    watch: Watch | None
    if training is None:
        watch, residuals = _crossed(complete, signal, before)
        known = complete
    else:
        known = with_bias(schema, schema.scaler.normalise(training[0]), training[1])
        known = known[np.isfinite(known[:, signal >= -1]).all(axis=1)]
        watch = Watch.fit(known, signal, before) if len(known) >= LEAST else None
        residuals = np.zeros((len(complete), 0)) if watch is None else watch.reading(None).residuals(complete)
    outputs = schema.out_layout.size
    network = all_errors(schema, NO_READING, complete, outputs)
    if watch is not None:
        network[:, ~_blind(schema)] = np.nan
    errors = np.concatenate([network, residuals], axis=1)
    spread = np.concatenate([schema.scaler.std[schema.out_index], np.ones(residuals.shape[1])])
    normal = Normal.fit(errors, spread, false_alarm)
    elements = np.flatnonzero(signal[: schema.layout.size] >= 0)
    cloud = np.full((min(len(known), neighbours.MOST), schema.layout.size), np.nan)
    cloud[:, elements] = _thinned(known, neighbours.MOST)[:, elements]
    kept = np.where(signal >= -1, _thinned(complete, KEPT), np.nan).astype(np.float32)
    plain = replace(normal, watch=watch, rows=kept)
    weight = _weight(schema, plain, complete, cloud, elements)
    if not weight:
        return plain
    near = neighbours.neighbourhood(cloud, elements)
    both = Normal.fit(errors, spread, false_alarm, neighbours.nearness(near, complete), weight)
    return replace(both, watch=watch, rows=kept, cloud=cloud.astype(np.float32))


def _columns(schema: BodySchema, x: np.ndarray) -> np.ndarray:
    """Return the signal of every column as a number; -1 for p, -2 for elements that are dead or mostly missing."""
    layout: Layout = schema.layout
    signal = np.concatenate([np.full(s.size, number) for number, s in enumerate(layout.signals)])
    signal[schema.scaler.dead] = -2
    signal[np.isfinite(x[:, : layout.size]).mean(axis=0) <= 0.5] = -2
    return np.concatenate([signal, np.full(x.shape[1] - layout.size, -1)])


def _check(complete: np.ndarray) -> None:
    if len(complete) < LEAST:
        raise NotEnoughData(
            f"What is normal is learned from at least {LEAST} complete samples; there are {len(complete)}."
        )


def _blind(schema: BodySchema) -> np.ndarray:
    """Return which elements of x_out the network predicts without their own signal, truth values, shape (out_size,)."""
    blind = [any(s.name not in mask for mask in schema.masks) for s in schema.out_layout.signals]
    return np.repeat(blind, [s.size for s in schema.out_layout.signals])


def _crossed(rows: np.ndarray, signal: np.ndarray, before: Watch | None) -> tuple[Watch, np.ndarray]:
    """Return a watch of all samples, and the residuals of each sample from a watch without its part of them."""
    parts = np.array_split(np.arange(len(rows)), 3)
    watch = Watch.fit(rows, signal, before)
    like = watch.penalties, watch.count - len(rows)
    residuals = [
        Watch.fit(np.delete(rows, part, axis=0), signal, before, like).reading(None).residuals(rows[part])
        for part in parts
    ]
    return watch, np.concatenate(residuals)


def _weight(schema: BodySchema, normal: Normal, rows: np.ndarray, cloud: np.ndarray, elements: np.ndarray) -> float:
    """Choose the weight of the distance from known samples: the one that finds imitated faults best.

    An imitated fault is a normal sample in which one element, or one signal, has the values of another moment.
    """
    if len(cloud) < 4 * LEAST or normal.scale is None:
        return 0.0
    random = np.random.default_rng(0)
    healthy = _thinned(rows, IMITATED)
    others = healthy[random.permutation(len(healthy))]
    signal = np.concatenate([np.full(s.size, number) for number, s in enumerate(schema.layout.signals)])
    place = random.choice(elements, len(healthy))
    faults = []
    for wrong in (np.arange(healthy.shape[1]) == place[:, None], np.zeros((0, 0), bool)):
        if not wrong.size:
            wrong = np.zeros(healthy.shape, bool)
            wrong[:, : len(signal)] = signal == signal[place][:, None]
        faults.append(np.where(wrong, others, healthy))
    near = neighbours.neighbourhood(cloud, elements)
    parts = [(_distances(schema, normal, part), neighbours.nearness(near, part)) for part in (healthy, *faults)]
    areas = []
    for weight in WEIGHTS:
        scale = Scale.of(*parts[0], weight)
        well, *ill = (scale.deviations(*part) for part in parts)
        areas.append(float(np.mean([area(values, well) for values in ill])))
    best = int(np.argmax(areas))
    return WEIGHTS[best] if areas[best] > areas[0] + BETTER else 0.0


def _distances(schema: BodySchema, normal: Normal, rows: np.ndarray) -> np.ndarray:
    """Return the Mahalanobis distances of complete samples [standard deviations] and their p, shape (n,)."""
    reading = NO_READING if normal.watch is None else normal.watch.reading(None)
    return normal.distances(all_errors(schema, reading, rows, len(normal.mean)))


def _thinned(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]
