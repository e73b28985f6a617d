"""Prediction errors of samples: network and watch, the masks that predict, and the judged elements (paper, II-K)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from gemuco.anomaly.neighbours import nearness, neighbourhood
from gemuco.compiled.score import Judges, Near
from gemuco.derived import ByPattern
from gemuco.masks import Mask
from gemuco.normal.statistics import Normal, Scale, covariance_of
from gemuco.normal.watch import NO_READING, Reading
from gemuco.schema import BodySchema, check_schema, stacked


def judging_masks(schema: BodySchema) -> dict[str, Mask]:
    """Choose the mask that predicts each signal of x_out for anomaly detection.

    If possible the mask lacks the signal itself, which the network would copy even when it is wrong.
    """
    chosen: dict[str, Mask] = {}
    for name in schema.x_out:
        blind = [mask for mask in schema.masks if name not in mask]
        chosen[name] = min(blind or schema.masks, key=lambda m: schema.mask_error(m, name))
    return chosen


def judges(schema: BodySchema) -> Judges:
    """Return the judging masks of a schema as arrays for compiled code."""
    by_signal = schema.derived(judging_masks)
    masks = list(dict.fromkeys(by_signal.values()))
    order = [masks.index(by_signal[s.name]) for s in schema.out_layout.signals for _ in range(s.size)]
    return Judges(*stacked(schema, masks), np.array(order))


def predict_error(schema: BodySchema, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return measured minus predicted of every x_out element [unit], shape (out_size,) or (samples, out_size).

    Each signal is predicted from the others where a feasible mask allows; NaN where something is missing.
    """
    check_schema(schema)
    return prediction_errors(schema, schema.normalise(values))


def prediction_errors(schema: BodySchema, x: np.ndarray) -> np.ndarray:
    """Return the network's errors, measured minus predicted [unit], shape (..., out_size).

    Args:
        schema: The body schema.
        x: Samples [standard deviations], shape (..., size).

    An element's error is NaN when it was not measured or when the mask that judges its signal lacks a value: another
    mask would make errors of another size, which the statistics of the normal do not describe.
    """
    error = np.full((*x.shape[:-1], schema.out_layout.size), np.nan)
    predicted: dict[Mask, np.ndarray] = {}
    for name, mask in schema.derived(judging_masks).items():
        if mask not in predicted:
            prediction = schema.infer(x, mask).astype(float)
            prediction[~np.isfinite(x[..., schema.layout.indices(mask)]).all(axis=-1)] = np.nan
            predicted[mask] = prediction
        span, out = schema.layout.slice(name), schema.out_layout.slice(name)
        error[..., out] = (x[..., span] - predicted[mask][..., out]) * schema.scaler.std[span]
    return error


def with_bias(schema: BodySchema, x: np.ndarray, bias: np.ndarray | None = None) -> np.ndarray:
    """Return samples [standard deviations], shape (n, size), followed by p: (n, size + bias_size)."""
    p = np.broadcast_to(schema.bias if bias is None else bias, (len(x), len(schema.bias)))
    return np.concatenate([x, p], axis=1)


def all_errors(schema: BodySchema, reading: Reading, rows: np.ndarray, count: int) -> np.ndarray:
    """Return the errors of the network [unit], then of the watch [standard deviations], shape (n, count).

    Args:
        schema: The body schema.
        reading: The watch of the elements that are measured in every sample.
        rows: Samples [standard deviations] and their p, shape (n, size + bias_size).
        count: Number of errors.
    """
    size, outputs = schema.layout.size, schema.out_layout.size
    errors = np.full((len(rows), count), np.nan)
    biases, owner = np.unique(rows[:, size:], axis=0, return_inverse=True)
    for number, bias in enumerate(biases):
        of = owner.reshape(-1) == number
        under = schema if np.array_equal(bias, schema.bias) else schema.with_bias(bias)
        errors[of, :outputs] = prediction_errors(under, rows[of, :size])
    if len(reading.kind):
        errors[:, outputs + reading.kind] = reading.residuals(rows)
    return errors


class Judged(NamedTuple):
    """Statistics for samples that lack the same elements.

    Attributes:
        reading: Closed-form prediction from the measured elements.
        near: Known samples; empty if their distance is not used.
        mean: Mean of every error, shape (errors,).
        place: Indices of the judged errors, shape (n,).
        precision: Inverse covariance of the judged errors, shape (n, n).
        scale: Logarithms of the distances of normal samples.
        element: Position in the layout of the element of every error, shape (errors,).
    """

    reading: Reading
    near: Near
    mean: np.ndarray
    place: np.ndarray
    precision: np.ndarray
    scale: Scale
    element: np.ndarray

    @property
    def parts(self) -> tuple[np.ndarray, ...]:
        """The arrays one by one, as `compiled.score.deviation` takes them: Python passes them faster than tuples."""
        reading = self.reading
        return (
            reading.inputs, reading.clips, reading.pairs, reading.maps, reading.kind, *self.near, self.mean, self.place,
            self.precision, np.array(self.scale, float), self.element,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Judgement:
    """Judgement of samples that lack the same elements.

    Attributes:
        judged: The statistics.
        parts: Their arrays.
        threshold: Score above which such a sample is an anomaly; NaN if no error is judged.
        is_complete: Whether every error is judged that is judged when no element is missing.
    """

    judged: Judged
    threshold: float
    is_complete: bool
    parts: tuple[np.ndarray, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", self.judged.parts)

    @classmethod
    def of(cls, schema: BodySchema, finite: np.ndarray) -> "Judgement":
        """Prepare for samples with these finite elements, truth values, shape (size,).

        A schema without statistics of prediction errors judges no element.
        """
        normal = schema.normal
        if normal is None:
            mean, element = np.zeros(schema.out_layout.size), schema.out_index
            empty = Judged(NO_READING, _NO_NEAR, mean, *_NO_PRECISION, Scale(0.0, 1.0), element)
            return cls(empty, float("nan"), False)
        columns = np.concatenate([finite, np.ones(len(schema.bias), bool)])
        reading = NO_READING if normal.watch is None else normal.watch.reading(columns)
        element = schema.out_index
        if normal.watch is not None:
            element = np.concatenate([element, normal.watch.reading(None).target])
        usable = _usable(schema, normal, reading, finite)
        near = _near(normal, finite)
        index = np.flatnonzero(usable)
        if normal.scale is None or not len(normal.rows):
            index, precision = normal.precision(usable)
            scale = Scale(0.0, 1.0) if normal.scale is None else normal.scale._replace(weight=0.0)
            judged = Judged(reading, near, normal.mean, index, precision, scale, element)
            return cls(judged, float(normal.threshold_of(len(index))), len(index) == normal.usual)
        if len(index) == normal.usual:
            index, precision = normal.precision(usable)
            judged = Judged(reading, near, normal.mean, index, precision, normal.scale, element)
            return cls(judged, normal.threshold, True)
        return cls._of_part(schema, normal, reading, near, index, finite, element)

    @classmethod
    def _of_part(
        cls, schema: BodySchema, normal: Normal, reading: Reading, near: Near, index: np.ndarray, finite: np.ndarray,
        element: np.ndarray,
    ) -> "Judgement":  # fmt: skip
        """Measure the normal samples that were kept as if they lacked the same elements.

        The closed-form prediction may have learned from them. How much larger the errors of samples are that it did
        not learn from is known of complete ones, and is taken for the same here.
        """
        assert normal.scale is not None and normal.windows is not None
        mean = np.full(len(normal.mean), np.nan)
        if not len(index):
            nothing = Judged(reading, near, mean, *_NO_PRECISION, Scale(0.0, 1.0), element)
            return cls(nothing, float("nan"), False)
        rows, usual = normal.rows.astype(float), np.flatnonzero(np.isfinite(normal.mean))
        known = schema.derived(_complete)
        growth = np.ones(len(mean))
        growth[usual] = np.sqrt(np.maximum(np.diag(normal.covariance)[usual] / np.diag(known.covariance), 1.0))
        rows[:, : len(finite)][:, ~finite] = np.nan
        own = _Measured.of(schema, normal, reading, near, index, rows, growth)
        mean[index] = own.mean
        scale = Scale(
            own.scale.mean + max(normal.scale.mean - known.scale.mean, 0.0),
            max(own.scale.std, normal.scale.std),
            own.scale.near_mean + max(normal.scale.near_mean - known.scale.near_mean, 0.0),
            max(own.scale.near_std, normal.scale.near_std),
            own.scale.weight,
        )
        judged = Judged(reading, near, mean, index, np.linalg.inv(own.covariance), scale, element)
        return cls(judged, float(scale.distance(normal.windows.limits[0])), False)


class _Measured(NamedTuple):
    """Statistics of the errors of samples that lack the same elements.

    Attributes:
        mean: Mean errors [unit of x_out, then standard deviations], shape (n,).
        covariance: Their covariance, shape (n, n).
        scale: Logarithms of the distances of the samples.
    """

    mean: np.ndarray
    covariance: np.ndarray
    scale: Scale

    @classmethod
    def of(
        cls, schema: BodySchema, normal: Normal, reading: Reading, near: Near, index: np.ndarray, rows: np.ndarray,
        growth: np.ndarray,
    ) -> "_Measured":  # fmt: skip
        """Measure the errors `index` of samples, shape (n, size + bias_size), all of them times `growth`."""
        assert normal.scale is not None
        errors = all_errors(schema, reading, rows, len(normal.mean))[:, index]
        spread = np.concatenate([schema.scaler.std[schema.out_index], np.ones(len(normal.mean))])[index]
        mean = errors.mean(axis=0)
        away = (errors - mean) * growth[index]
        covariance = covariance_of(away, spread, normal.shrink)
        distances = np.sqrt(np.einsum("ij,jk,ik->i", away, np.linalg.inv(covariance), away).clip(min=0.0))
        weight = normal.scale.weight if len(near.elements) else 0.0
        return cls(
            mean, covariance, Scale.of(distances, nearness(near, rows) if weight else np.ones(len(rows)), weight)
        )


def _complete(schema: BodySchema) -> _Measured:
    """Return the statistics of the kept normal samples with all their elements."""
    normal = schema.normal
    assert normal is not None
    reading = NO_READING if normal.watch is None else normal.watch.reading(None)
    near, usual = _near(normal, np.ones(schema.layout.size, bool)), np.flatnonzero(np.isfinite(normal.mean))
    return _Measured.of(schema, normal, reading, near, usual, normal.rows.astype(float), np.ones(len(normal.mean)))


def _usable(schema: BodySchema, normal: Normal, reading: Reading, finite: np.ndarray) -> np.ndarray:
    """Return the errors that can be computed from the finite elements and are known, truth values, shape (errors,)."""
    by = schema.derived(judges)
    complete = np.array([finite[schema.in_index[through > 0]].all() for through in by.through])
    usable = np.zeros(len(normal.mean), bool)
    usable[: len(by.mask)] = finite[schema.out_index] & complete[by.mask]
    usable[len(by.mask) + reading.kind] = True
    return usable & np.isfinite(normal.mean)


def _near(normal: Normal, finite: np.ndarray) -> Near:
    """Return the known samples for a distance by the finite elements."""
    if normal.scale is None or not normal.scale.weight:
        return _NO_NEAR
    return neighbourhood(normal.cloud, np.flatnonzero(finite & np.isfinite(normal.cloud).all(axis=0)))


_NO_NEAR = Near(np.zeros((0, 0)), np.zeros(0), np.zeros(0, int))
_NO_PRECISION = (np.zeros(0, int), np.zeros((0, 0)))


def judgements(schema: BodySchema) -> ByPattern[Judgement]:
    """Return the judgements of a schema, by the finite elements of a sample."""
    return ByPattern(partial(Judgement.of, schema))
