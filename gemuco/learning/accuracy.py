"""Errors of a schema on held-out data, and the statistics of its normal errors."""

from collections.abc import Iterable

import numpy as np

from gemuco.anomaly.healthy import learn_normal
from gemuco.errors import NotEnoughData
from gemuco.estimation import input_search, latent_search
from gemuco.intervals.calibration import calibrate
from gemuco.masks import Mask, all_masks, covered_by
from gemuco.schema import BodySchema
from gemuco.search.routes import STARTS

MOST_OUTPUTS = 6
"""Up to this number of outputs the latent search is measured from every set of outputs; above, from all but one."""

MOST_PAIRS = 400_000
"""At most this many pairs of sample and mask are measured; the samples are thinned evenly."""

MOST_SEARCHED = 4
"""Up to this number of signals the input search is measured from every set of signals; above, from all but one."""


ErrorRows = dict[tuple[str, Mask], np.ndarray]
"""(method, given signals) -> errors of single samples [standard deviations], shape (samples, elements), NaN where not
measured. The elements are those of x_out; for the method `input` those of the layout."""


def assess(
    schema: BodySchema,
    rows: np.ndarray,
    conditions: np.ndarray,
    training: tuple[np.ndarray, np.ndarray] | None = None,
) -> BodySchema:
    """Return the schema with its held-out errors, the calibration of its std, and the statistics of its normal errors.

    Args:
        schema: The body schema.
        rows: Held-out samples [unit], oldest first, shape (samples, layout.size), NaN where not measured.
        conditions: Index into `schema.biases` of every row, shape (samples,); ignored without parametric bias.
        training: Samples that were learned from, and their conditions, from which every signal's relation to the others
            is learned; the held-out samples if not given.
    """
    errors = error_rows(schema, rows, conditions)
    schema = schema.with_weights(
        schema.weights, {key: rms(part) * scale_of(schema, key) for key, part in errors.items()}
    )
    learned = None if training is None else (training[0], bias_of(schema, training[1]))
    held = schema.scaler.normalise(rows), bias_of(schema, conditions)
    known = held[0] if learned is None else schema.scaler.normalise(learned[0])
    schema = schema.with_certainty(calibrate(schema, held, known, errors))
    try:
        return schema.with_normal(learn_normal(schema, rows, bias_of(schema, conditions), training=learned))
    except NotEnoughData:
        return schema.with_normal(None)


def measure_errors(schema: BodySchema, rows: np.ndarray, conditions: np.ndarray) -> dict[tuple[str, Mask], np.ndarray]:
    """Measure the root mean square error of every way to estimate, with each sample under the p of its condition.

    Args:
        schema: The body schema.
        rows: Held-out samples [unit], shape (samples, layout.size), NaN where not measured.
        conditions: Index into `schema.biases` of every row, shape (samples,); ignored without parametric bias.

    Returns:
        (method, given signals) -> error of every x_out element [unit], shape (out_size,); for the method `input` of
        every element of the layout, shape (size,). The error of an element that was never measured is its standard
        deviation.
    """
    errors = error_rows(schema, rows, conditions)
    return {key: rms(part) * scale_of(schema, key) for key, part in errors.items()}


def scale_of(schema: BodySchema, key: tuple[str, Mask]) -> np.ndarray:
    """Return the standard deviations of the elements whose errors a key of the error table has [unit]."""
    return schema.scaler.std if key[0] == "input" else schema.scaler.std[schema.out_index]


def error_rows(schema: BodySchema, rows: np.ndarray, conditions: np.ndarray) -> ErrorRows:
    """Return the errors of single samples for every way to estimate; see `measure_errors`."""
    thinned = np.linspace(0, len(rows) - 1, min(len(rows), MOST_PAIRS // len(schema.masks) + 1)).astype(int)
    rows, conditions = rows[thinned], conditions[thinned]
    x = schema.scaler.normalise(rows)
    truth = x[:, schema.out_index]
    p = bias_of(schema, conditions)
    errors: ErrorRows = {}
    for m in schema.masks:
        usable = np.isfinite(x[:, schema.layout.indices(m)]).all(axis=1)
        if usable.any():
            errors["mask", m] = schema.infer(x[usable], m, p[usable]) - truth[usable]
    complete = np.flatnonzero(np.isfinite(x).all(axis=1))
    if not len(complete):
        return errors
    tests = complete[np.linspace(0, len(complete) - 1, min(STARTS, len(complete))).astype(int)]
    variants = _by_condition(schema, conditions[tests])
    for given in _latent_sets(schema):
        hidden = _only(schema, x[tests], given)
        solutions = np.empty((len(tests), len(schema.out_index)))
        for variant, samples in variants:
            solutions[samples] = [latent_search(variant, row) for row in hidden[samples]]
        errors["latent", given] = solutions - truth[tests]
    for given in _input_sets(schema):
        hidden = _only(schema, x[tests], given)
        solutions = np.empty_like(hidden)
        for variant, samples in variants:
            solutions[samples] = [input_search(variant, row, given) for row in hidden[samples]]
        errors["input", given] = solutions - x[tests]
    return errors


def bias_of(schema: BodySchema, conditions: np.ndarray) -> np.ndarray:
    """Return p of every sample, shape (samples, bias_size), from indices into `schema.biases`, shape (samples,)."""
    if not len(schema.bias):
        return np.zeros((len(conditions), 0), np.float32)
    return np.stack(list(schema.biases.values()))[conditions]


def _by_condition(schema: BodySchema, conditions: np.ndarray) -> list[tuple[BodySchema, np.ndarray]]:
    """Return pairs: the schema under each condition that occurs, and the indices of the samples of this condition."""
    if not len(schema.bias):
        return [(schema, np.arange(len(conditions)))]
    names = list(schema.biases)
    return [(schema.under(names[i]), np.flatnonzero(conditions == i)) for i in np.unique(conditions)]


def _only(schema: BodySchema, x: np.ndarray, given: Mask) -> np.ndarray:
    """Return samples with NaN in all signals that are not given, shape (samples, layout.size)."""
    return np.where(np.isin(np.arange(x.shape[1]), schema.layout.indices(given)), x, np.nan)


def _latent_sets(schema: BodySchema) -> Iterable[Mask]:
    """List the sets of outputs from which a latent search may have to infer the others: no mask covers them."""
    outputs = schema.x_out
    many = len(outputs) > MOST_OUTPUTS
    sets = [frozenset(outputs) - {name} for name in outputs] if many else all_masks(outputs)
    return [g for g in sets if len(g) < len(outputs) and not any(m <= g for m in schema.masks)]


def _input_sets(schema: BodySchema) -> Iterable[Mask]:
    """List the sets of signals from which an input search may have to infer inputs that are not outputs."""
    names = schema.layout.subset({*schema.x_in, *schema.x_out}).names
    targets = [name for name in names if name not in schema.x_out]
    sets = all_masks(names) if len(names) <= MOST_SEARCHED else [frozenset(names) - {name} for name in targets]
    return [
        given
        for given in sets
        if any(name in given for name in schema.x_out)
        and any(name not in given and covered_by(schema.masks, given | {name}) for name in targets)
        and not all(name in given for name in targets)
    ]


def rms(errors: np.ndarray) -> np.ndarray:
    """Return the root mean square over the samples, shape (out_size,); 1 where no sample was measured."""
    measured = np.isfinite(errors)
    count = measured.sum(axis=0)
    squares = (np.where(measured, errors, 0.0) ** 2).sum(axis=0)
    return np.where(count > 0, np.sqrt(squares / np.maximum(count, 1)), 1.0)
