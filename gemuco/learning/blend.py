"""Share of the network in every output under every mask; the rest is the linear path itself.

A relation that is linear is as exact in the network as the other relations let it be. Where the linear path alone
predicts held-out samples better it predicts alone, also outside of the training data, and inputs that are of no use do
no harm.
"""

from dataclasses import replace

import numpy as np

from gemuco.layers import run
from gemuco.learning.accuracy import bias_of
from gemuco.masks import Mask
from gemuco.schema import BodySchema

LEAST = 0.3
"""A smaller share is 0: the update of W divides by it."""
MOST = 0.9
"""A larger share is 1."""
ENOUGH = 20
"""With fewer held-out samples under a mask the network predicts alone."""


def blended(schema: BodySchema, rows: np.ndarray, conditions: np.ndarray) -> BodySchema:
    """Return the schema with the shares that predict held-out samples best.

    Args:
        schema: The body schema.
        rows: Held-out samples [unit], shape (samples, layout.size), NaN where not measured.
        conditions: Index into `schema.biases` of every row, shape (samples,); ignored without parametric bias.
    """
    if not schema.path.width:
        return schema
    whole = replace(schema, shares={})
    x, p = whole.scaler.normalise(rows), bias_of(whole, conditions)
    return replace(schema, shares={mask: _shares(whole, mask, x, p) for mask in whole.masks})


def _shares(schema: BodySchema, mask: Mask, x: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the shares under a mask, shape (out_size,)."""
    share = np.ones(len(schema.out_index))
    usable = np.isfinite(x[:, schema.layout.indices(mask)]).all(axis=1)
    if usable.sum() < ENOUGH:
        return share
    x, truth = x[usable], x[np.ix_(usable, schema.out_index)]
    through = schema.gate(mask).through
    line = schema.path.direct(through, np.zeros(len(share)))[:-1]
    network = run(schema.weights.whole, schema.network_input(x, mask, p[usable])) - truth
    linear = np.where(through, x[:, schema.in_index], 0.0) @ line[:-1] + line[-1] - truth
    known = np.isfinite(truth)
    network, linear = np.where(known, network, 0.0), np.where(known, linear, 0.0)
    gain = linear - network
    best = (linear * gain).sum(axis=0) / np.maximum((gain**2).sum(axis=0), 1e-30)
    best = np.where(known.sum(axis=0) < ENOUGH, 1.0, best)
    return np.where(best < LEAST, 0.0, np.where(best > MOST, 1.0, best))
