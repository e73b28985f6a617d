"""How far a schema is from the truth on data it was not trained on: the errors it promises, and what is normal."""

from collections.abc import Iterable

import numpy as np

from gemuco.anomaly.prediction import predict_error
from gemuco.errors import NotEnoughData
from gemuco.estimation import input_search, latent_search
from gemuco.layers import run
from gemuco.masks import Mask, all_masks, covered_by
from gemuco.normal import Normal
from gemuco.schema import BodySchema
from gemuco.search.routes import STARTS

MOST_OUTPUTS = 6
"""Up to so many outputs, every set of them is tried as what a latent search is given; beyond, sets that lack one."""

MOST_PAIRS = 400_000
"""Pairs of sample and mask that are measured, at most; the samples are thinned evenly."""

MOST_SEARCHED = 4
"""Up to so many signals, every set of them is tried as what an input search is given; beyond, sets that lack one."""


def assess(schema: BodySchema, rows: np.ndarray, conditions: np.ndarray) -> BodySchema:
    """The schema with its held-out errors and its statistics of the normal.

    Args:
        schema: The body schema.
        rows: Held-out samples [unit], oldest first, shape (samples, layout.size), NaN where nothing was measured.
        conditions: Index into `schema.biases` of every row, shape (samples,); ignored without parametric bias.
    """
    schema = schema.with_weights(schema.weights, measure_errors(schema, rows, conditions))
    errors = np.full((len(rows), len(schema.out_index)), np.nan)
    for under, chosen in _by_condition(schema, conditions):
        errors[chosen] = predict_error(under, schema.layout.split(rows[chosen]))
    try:
        return schema.with_normal(Normal.fit(errors, schema.scaler.std[schema.out_index]))
    except NotEnoughData:
        return schema.with_normal(None)


def measure_errors(schema: BodySchema, rows: np.ndarray, conditions: np.ndarray) -> dict[tuple[str, Mask], np.ndarray]:
    """Root mean square errors of every way to estimate, each sample under the p of its condition.

    Args:
        schema: The body schema.
        rows: Held-out samples [unit], shape (samples, layout.size), NaN where nothing was measured.
        conditions: Index into `schema.biases` of every row, shape (samples,); ignored without parametric bias.

    Returns:
        (method, signals given) -> error of every x_out element [unit], shape (out_size,); for the method `input` of
        every element of the layout, shape (size,). Where nothing was measured it is the element's standard deviation:
        as if nothing was known.
    """
    kept = np.linspace(0, len(rows) - 1, min(len(rows), MOST_PAIRS // len(schema.masks) + 1)).astype(int)
    rows, conditions = rows[kept], conditions[kept]
    x = schema.scaler.normalise(rows)
    truth, scale = x[:, schema.out_index], schema.scaler.std[schema.out_index]
    p = bias_of(schema, conditions)
    found: dict[tuple[str, Mask], np.ndarray] = {}
    for m in schema.masks:
        there = np.isfinite(x[:, schema.layout.indices(m)]).all(axis=1)
        if there.any():
            told = run(schema.weights.whole, schema.network_input(x[there], m, p[there]))
            found["mask", m] = _rms(told - truth[there]) * scale
    complete = np.flatnonzero(np.isfinite(x).all(axis=1))
    if len(complete):
        some = complete[np.linspace(0, len(complete) - 1, min(STARTS, len(complete))).astype(int)]
        for given in _partial(schema):
            hidden = x[some]
            hidden[:, ~np.isin(np.arange(x.shape[1]), schema.layout.indices(given))] = np.nan
            guesses = np.empty((len(some), len(schema.out_index)))
            for under, chosen in _by_condition(schema, conditions[some]):
                guesses[chosen] = [latent_search(under, row) for row in hidden[chosen]]
            found["latent", given] = _rms(guesses - truth[some]) * scale
        for given in _inverse(schema):
            hidden = x[some]
            hidden[:, ~np.isin(np.arange(x.shape[1]), schema.layout.indices(given))] = np.nan
            guesses = np.empty_like(hidden)
            for under, chosen in _by_condition(schema, conditions[some]):
                guesses[chosen] = [input_search(under, row, given) for row in hidden[chosen]]
            found["input", given] = _rms(guesses - x[some]) * schema.scaler.std
    return found


def bias_of(schema: BodySchema, conditions: np.ndarray) -> np.ndarray:
    """The p of every sample, shape (samples, bias_size), from indices into `schema.biases`, shape (samples,)."""
    if not len(schema.bias):
        return np.zeros((len(conditions), 0), np.float32)
    return np.stack(list(schema.biases.values()))[conditions]


def _by_condition(schema: BodySchema, conditions: np.ndarray) -> list[tuple[BodySchema, np.ndarray]]:
    """The schema under each condition that occurs, and the samples of it."""
    if not len(schema.bias):
        return [(schema, np.arange(len(conditions)))]
    names = list(schema.biases)
    return [(schema.under(names[i]), np.flatnonzero(conditions == i)) for i in np.unique(conditions)]


def _partial(schema: BodySchema) -> Iterable[Mask]:
    """Sets of outputs from which a latent search may have to tell the others: no mask covers them."""
    outputs = schema.x_out
    many = len(outputs) > MOST_OUTPUTS
    sets = [frozenset(outputs) - {name} for name in outputs] if many else all_masks(outputs)
    return [g for g in sets if len(g) < len(outputs) and not any(m <= g for m in schema.masks)]


def _inverse(schema: BodySchema) -> Iterable[Mask]:
    """Sets of signals from which an input search may have to tell inputs that are no outputs."""
    names = schema.layout.subset({*schema.x_in, *schema.x_out}).names
    sought = [name for name in names if name not in schema.x_out]
    sets = all_masks(names) if len(names) <= MOST_SEARCHED else [frozenset(names) - {name} for name in sought]
    return [
        given
        for given in sets
        if any(name in given for name in schema.x_out)
        and any(name not in given and covered_by(schema.masks, given | {name}) for name in sought)
        and not all(name in given for name in sought)
    ]


def _rms(errors: np.ndarray) -> np.ndarray:
    """Over the samples, shape (out_size,); 1 where none was measured."""
    there = np.isfinite(errors)
    count = there.sum(axis=0)
    squares = (np.where(there, errors, 0.0) ** 2).sum(axis=0)
    return np.where(count > 0, np.sqrt(squares / np.maximum(count, 1)), 1.0)
