"""Learning of what is normal: from training data, or anew from samples of the body as it is now (paper, II-K)."""

from dataclasses import replace
from typing import TypeVar

import numpy as np

from gemuco.anomaly import neighbours
from gemuco.anomaly.prediction import all_errors, with_bias
from gemuco.compiled.score import Near
from gemuco.errors import NotEnoughData
from gemuco.normal.statistics import FOLDS, KEPT, LEAST, SHRINK, Normal, Scale, covariance_of
from gemuco.normal.watch import NO_READING, Watch
from gemuco.normal.windows import area
from gemuco.schema import BodySchema
from gemuco.signals import Layout

T = TypeVar("T")

WEIGHTS = (0.0, 0.5, 1.0)
"""Weights of the distance from known samples that are compared."""

SHRINKS = (SHRINK, 0.3, 0.05)
"""Shares of the covariance to be replaced by its diagonal that are compared."""

BETTER = 0.005
"""Another choice than the first must find imitated faults better by this area under the ROC curve."""

IMITATED = 600
"""Choices are compared on this number of normal samples and as many imitated faults of each kind."""

BLOCKS = 10
"""The normal samples are divided into this number of blocks, of which every second one is judged."""

OFF = {"element": 0.3, "signal": 0.1}
"""Imitated faults are also one element off by this, and all elements of a signal by that [standard deviations]."""


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
    if not (signal >= 0).any():
        raise NotEnoughData("No signal is measured in most samples, so normal errors cannot be learned.")
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
        network[:, ~_is_better(schema, watch, network, residuals)] = np.nan
    errors = np.concatenate([network, residuals], axis=1)
    spread = np.concatenate([schema.scaler.std[schema.out_index], np.ones(residuals.shape[1])])
    elements = np.flatnonzero(signal[: schema.layout.size] >= 0)
    trial = _Trial(schema, watch, complete, errors, spread, elements)
    used = np.isfinite(errors).all(axis=0)
    shrink = trial.shrink(used)
    cloud = np.full((min(len(known), neighbours.MOST), schema.layout.size), np.nan)
    cloud[:, elements] = _thinned(known, neighbours.MOST)[:, elements]
    weight = trial.weight(known if training is not None else None, used, shrink)
    kept = np.where(signal >= -1, _thinned(complete, KEPT), np.nan).astype(np.float32)
    near = None
    if weight and training is None:
        near = _apart(complete, elements)
    elif weight:
        near = neighbours.nearness(neighbours.neighbourhood(cloud, elements), complete)
    normal = Normal.fit(errors, spread, false_alarm, near, weight, shrink, complete[:, : schema.layout.size])
    return replace(normal, watch=watch, rows=kept, cloud=cloud.astype(np.float32) if weight else normal.cloud)


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


def _is_better(schema: BodySchema, watch: Watch, network: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Return where the network predicts x_out better than the watch does, truth values, shape (out_size,).

    Where every mask contains the signal itself, the network copies it, and its error shows no fault.
    """
    blind = [any(s.name not in mask for mask in schema.masks) for s in schema.out_layout.signals]
    by_network = np.sqrt(np.mean(network**2, axis=0)) / schema.scaler.std[schema.out_index]
    by_watch = np.full(schema.layout.size, np.inf)
    np.minimum.at(by_watch, watch.reading(None).target, np.sqrt(np.mean(residuals**2, axis=0)))
    better = by_network < by_watch[schema.out_index]
    return np.asarray(better & np.repeat(blind, [s.size for s in schema.out_layout.signals]))


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


class _Trial:
    """Choices that are made by imitated faults: which find more of them in normal samples, decides.

    An imitated fault is a normal sample in which one element, or one signal, has the values of another moment or is a
    little off. Mean and covariance are those of every second block of samples; the others are judged.
    """

    def __init__(
        self, schema: BodySchema, watch: Watch | None, rows: np.ndarray, errors: np.ndarray, spread: np.ndarray,
        elements: np.ndarray,
    ) -> None:  # fmt: skip
        reading = NO_READING if watch is None else watch.reading(None)
        is_judged = (BLOCKS * np.arange(len(rows)) // len(rows)) % 2 == 1
        self._first, self._spread = errors[~is_judged], spread
        self._others, self._elements = rows[~is_judged], elements
        self._parts = _with_faults(schema, _thinned(rows[is_judged], IMITATED), elements)
        self._errors = [all_errors(schema, reading, part, errors.shape[1]) for part in self._parts]

    def shrink(self, used: np.ndarray) -> float:
        """Choose the regularisation of the covariance of some errors, truth values, shape (errors,)."""
        return self._best(list(SHRINKS), [self._area(self._distances(used, shrink)) for shrink in SHRINKS])

    def weight(self, known: np.ndarray | None, used: np.ndarray, shrink: float) -> float:
        """Choose the weight of the distance from known samples; None: from those that are not judged."""
        distances = self._distances(used, shrink)
        near = _near(self._others if known is None else known, self._elements)
        nearness = [neighbours.nearness(near, part) for part in self._parts]
        areas = []
        for weight in WEIGHTS:
            scale = Scale.of(distances[0], nearness[0], weight)
            areas.append(self._area([scale.deviations(*part) for part in zip(distances, nearness, strict=True)]))
        return self._best(list(WEIGHTS), areas)

    def _distances(self, used: np.ndarray, shrink: float) -> list[np.ndarray]:
        first = self._first[:, used]
        precision = np.linalg.inv(covariance_of(first, self._spread[used], shrink))
        away = [errors[:, used] - first.mean(axis=0) for errors in self._errors]
        return [np.sqrt(np.einsum("ij,jk,ik->i", e, precision, e).clip(min=0.0)) for e in away]

    @staticmethod
    def _area(parts: list[np.ndarray]) -> float:
        return float(np.mean([area(ill, parts[0]) for ill in parts[1:]]))

    @staticmethod
    def _best(choices: list[T], areas: list[float]) -> T:
        best = int(np.argmax(areas))
        return choices[best] if areas[best] > areas[0] + BETTER else choices[0]


def _with_faults(schema: BodySchema, healthy: np.ndarray, elements: np.ndarray) -> list[np.ndarray]:
    """Return normal samples and their p, shape (n, size + bias_size), then every kind of imitated fault in them."""
    random = np.random.default_rng(0)
    others, place = healthy[random.permutation(len(healthy))], random.choice(elements, len(healthy))
    one = np.arange(healthy.shape[1]) == place[:, None]
    number = np.concatenate([np.full(s.size, index) for index, s in enumerate(schema.layout.signals)])
    whole = np.zeros(healthy.shape, bool)
    whole[:, : len(number)] = number == number[place][:, None]
    sign = random.choice([-1.0, 1.0], healthy.shape)
    return [
        healthy,
        np.where(one, others, healthy),
        np.where(whole, others, healthy),
        np.where(one, healthy + OFF["element"] * sign, healthy),
        np.where(whole, healthy + OFF["signal"] * sign, healthy),
    ]


def _near(rows: np.ndarray, elements: np.ndarray) -> Near:
    return neighbours.neighbourhood(_thinned(rows, neighbours.MOST), elements)


def _apart(rows: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Return the distance of every sample from the nearest of other parts of the motion, shape (n,).

    The samples right before and after it are nearly the same, and say nothing of the next posture.
    """
    parts = np.array_split(np.arange(len(rows)), FOLDS)
    return np.concatenate(
        [neighbours.nearness(_near(np.delete(rows, part, axis=0), elements), rows[part]) for part in parts]
    )


def _thinned(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]
