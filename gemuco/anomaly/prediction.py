"""Prediction errors of samples: the masks that predict, the errors, and the judged elements (paper, II-K)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from gemuco.compiled.score import Judges
from gemuco.derived import ByPattern
from gemuco.masks import Mask
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
    """Return measured minus predicted [unit], shape (..., out_size).

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


@dataclass(frozen=True, slots=True)
class Judgement:
    """Judgement of samples that lack the same elements.

    Attributes:
        index: Positions of the judged elements in x_out, shape (n,).
        precision: The inverse covariance of their errors, shape (n, n).
        threshold: Score above which such a sample is an anomaly; NaN if no element is judged.
    """

    index: np.ndarray
    precision: np.ndarray
    threshold: float

    @classmethod
    def of(cls, schema: BodySchema, finite: np.ndarray) -> "Judgement":
        """Prepare for samples with these finite elements, truth values, shape (size,).

        A schema without statistics of prediction errors judges no element.
        """
        if schema.normal is None:
            return cls(np.zeros(0, int), np.zeros((0, 0)), float("nan"))
        by = schema.derived(judges)
        complete = np.array([finite[schema.in_index[through > 0]].all() for through in by.through])
        judged = finite[schema.out_index] & complete[by.mask] & np.isfinite(schema.normal.mean)
        index, precision = schema.normal.precision(judged)
        return cls(index, precision, float(schema.normal.threshold_of(len(index))))


def judgements(schema: BodySchema) -> ByPattern[Judgement]:
    """Return the judgements of a schema, by the finite elements of a sample."""
    return ByPattern(partial(Judgement.of, schema))
