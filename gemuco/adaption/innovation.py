"""What a sample says about p: the errors of everything that was predicted without being told, and how p moves them."""

from dataclasses import dataclass

import numpy as np

from gemuco.compiled.innovation import innovations
from gemuco.layers import run
from gemuco.masks import Mask
from gemuco.schema import BodySchema

SHRINK = 0.05
"""Share of the covariance that is replaced by its diagonal."""
FLOOR = 0.01
"""Smallest standard deviation of an error [standard deviations of the signal]."""
MOST = 96
"""Errors judged at once; with more masks than fill this, those of the fewest signals come first."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Which errors a sample allows: for each, a mask and an element of x_out that the mask does not contain.

    Attributes:
        masks: The masks that are whole.
        index: Position of every error in the (masks, out_size) table, flattened, shape (n,).
        whiten: Turns errors into independent ones of variance 1, shape (n, n).
        log_volume: Logarithm of the determinant of the errors' covariance.
        through: What each mask lets through, shape (masks, in_size).
        tails: m of each mask, and room for p, shape (masks, x_in signals + bias_size).
    """

    masks: tuple[Mask, ...]
    index: np.ndarray
    whiten: np.ndarray
    log_volume: float
    through: np.ndarray
    tails: np.ndarray


class Innovations:
    """Errors and their derivatives by p, with the covariance that errors had in training.

    All feasible masks that are whole for a sample contribute. Their errors are of the same measurements and of the same
    network, so they are far from independent: the covariance of all of them together is measured on the anchors, under
    the p of each anchor's own condition, and enlarged to the errors of held-out data. A signal that is part of the mask
    is left out, for the network then copies it, whatever p is.
    """

    def __init__(self, schema: BodySchema) -> None:
        self._schema = schema
        self._pairs: dict[bytes, Pairs] = {}
        anchors = schema.anchors
        self._anchors = anchors[np.isfinite(anchors).all(axis=1)] if len(anchors) else anchors
        self._biases = own_bias(schema, len(anchors))
        if len(anchors):
            self._biases = self._biases[np.isfinite(anchors).all(axis=1)]
        self._anchor_errors: dict[Mask, np.ndarray] = {}

    def pairs(self, finite: np.ndarray) -> Pairs:
        """What a sample allows whose measured elements are given as truth values, shape (size,)."""
        key = finite.tobytes()
        found = self._pairs.get(key)
        if found is None:
            found = self._pairs[key] = self._allowed(finite)
        return found

    def _allowed(self, finite: np.ndarray) -> Pairs:
        schema = self._schema
        whole = schema.layout.whole(finite)
        masks = sorted((m for m in schema.masks if m <= whole), key=lambda m: (len(m), sorted(m)))
        there = finite[schema.out_index]
        table = np.array([there & self._blind(m) for m in masks]).reshape(len(masks), len(there))
        if not table.any():
            table = np.repeat(there[None], len(masks), axis=0)
        index = np.flatnonzero(table)[:MOST]
        used = len(there) and (index[-1] // len(there) + 1 if len(index) else 0)
        chosen = tuple(masks[:used])
        covariance = self._covariance(chosen)[np.ix_(index, index)] if len(index) else np.zeros((0, 0))
        lower = np.linalg.cholesky(covariance)
        gates = [schema.gate(m) for m in chosen]
        through, tails = (np.stack(column) for column in zip(*gates, strict=True)) if gates else [np.zeros((0, 0))] * 2
        volume = 2.0 * float(np.log(np.diag(lower)).sum())
        return Pairs(chosen, index, np.ascontiguousarray(np.linalg.inv(lower)), volume, through, tails)

    def _blind(self, mask: Mask) -> np.ndarray:
        inside = [name in mask for name in self._schema.x_out]
        sizes = [self._schema.layout.signal(name).size for name in self._schema.x_out]
        return ~np.repeat(inside, sizes)

    def _covariance(self, masks: tuple[Mask, ...]) -> np.ndarray:
        """Covariance of the errors of all elements under all masks, shape (masks * out_size, masks * out_size)."""
        schema = self._schema
        scale = schema.scaler.std[schema.out_index]
        held = np.concatenate([schema.errors.get(("mask", m), scale) / scale for m in masks])
        held = np.where(np.isfinite(held), held, 1.0)
        if len(self._anchors) < 3 * len(held):
            return np.diag(held**2 + FLOOR**2)
        errors = np.concatenate([self._errors_on_anchors(m) for m in masks], axis=1)
        covariance = errors.T @ errors / len(errors)
        spread = np.sqrt(np.diag(covariance))
        growth = np.maximum(held / np.maximum(spread, 1e-9), 1.0)
        covariance *= np.outer(growth, growth)
        variance = np.diag(covariance)
        return (1.0 - SHRINK) * covariance + np.diag(SHRINK * variance + FLOOR**2)

    def _errors_on_anchors(self, mask: Mask) -> np.ndarray:
        known = self._anchor_errors.get(mask)
        if known is None:
            schema = self._schema
            inputs = schema.network_input(self._anchors, mask, self._biases)
            found = run(schema.weights.whole, inputs).astype(float)
            known = self._anchor_errors[mask] = self._anchors[:, schema.out_index] - found
        return known

    def of(
        self, schema: BodySchema, pairs: Pairs, rows: np.ndarray, biases: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Whitened errors and their derivatives: error(p + dp) = error - derivative dp.

        Args:
            schema: Whose W predicts.
            pairs: Which errors; every row must allow them.
            rows: Samples [standard deviations], shape (rows, size).
            biases: p of every row, shape (rows, bias_size).

        Returns:
            Errors, shape (rows, n), and derivatives, shape (rows, n, bias_size), in float64.
        """
        p = np.ascontiguousarray(biases, np.float32)
        x = np.ascontiguousarray(rows, float)
        return innovations(schema.predictor, x, p, pairs.through, pairs.tails, pairs.index, pairs.whiten)


def own_bias(schema: BodySchema, count: int) -> np.ndarray:
    """The p of the condition that every anchor was recorded under, shape (count, bias_size), or the present p."""
    if len(schema.anchor_conditions) == count and schema.biases and count:
        return np.stack(list(schema.biases.values()))[schema.anchor_conditions]
    return np.repeat(schema.bias[None], count, axis=0)
