"""Information of a sample about p: errors of predictions, and their derivatives by p."""

from dataclasses import dataclass

import numpy as np

from gemuco.compiled.innovation import innovations
from gemuco.masks import Mask
from gemuco.schema import BodySchema, stacked

SHRINK = 0.05
"""This share of the covariance is replaced by its diagonal."""
FLOOR = 0.01
"""The standard deviation of an error is at least this [standard deviations of the signal]."""
MOST = 96
"""At most this many errors are judged at once, those of masks with few signals first."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The errors of a sample: each has a mask and an element of x_out that the mask does not contain.

    Attributes:
        masks: The masks that the sample covers.
        index: Position of every error in the flattened table (masks, out_size), shape (n,).
        whiten: Matrix that makes errors independent with variance 1, shape (n, n).
        log_volume: Logarithm of the determinant of the errors' covariance.
        through: Gate of each mask, shape (masks, in_size).
        paths: Regression of the code l under each mask, shape (masks, in_size + 1, width).
        tails: m of each mask, and space for p, shape (masks, x_in signals + bias_size).
        directs: Part of the linear path in x_out under each mask, shape (masks, in_size + 2, out_size).
    """

    masks: tuple[Mask, ...]
    index: np.ndarray
    whiten: np.ndarray
    log_volume: float
    through: np.ndarray
    paths: np.ndarray
    tails: np.ndarray
    directs: np.ndarray

    @property
    def parts(self) -> tuple[np.ndarray, ...]:
        """The arrays as `compiled.innovation.innovations` takes them."""
        return self.through, self.paths, self.tails, self.directs, self.index, self.whiten


class Innovations:
    """Errors and their derivatives by p, with the covariance that errors had in training.

    All feasible masks that a sample covers contribute. Their errors come from the same measurements and the same
    network, so they are far from independent: their joint covariance is measured on the anchors, under the p of each
    anchor's own condition, and enlarged to the errors of held-out data. Signals of the mask are left out, for the
    network copies them whatever p is.
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
        """Return the pairs of a sample by its measured elements, truth values, shape (size,)."""
        key = finite.tobytes()
        pairs = self._pairs.get(key)
        if pairs is None:
            pairs = self._pairs[key] = self._allowed(finite)
        return pairs

    def _allowed(self, finite: np.ndarray) -> Pairs:
        schema = self._schema
        whole = schema.layout.whole(finite)
        masks = sorted((m for m in schema.masks if m <= whole), key=lambda m: (len(m), sorted(m)))
        measured = finite[schema.out_index]
        table = np.array([measured & self._blind(m) for m in masks]).reshape(len(masks), len(measured))
        if not table.any():
            table = np.repeat(measured[None], len(masks), axis=0)
        index = np.flatnonzero(table)[:MOST]
        used = len(measured) and (index[-1] // len(measured) + 1 if len(index) else 0)
        chosen = tuple(masks[:used])
        covariance = self._covariance(chosen)[np.ix_(index, index)] if len(index) else np.zeros((0, 0))
        lower = np.linalg.cholesky(covariance)
        gates = stacked(schema, chosen)
        volume = 2.0 * float(np.log(np.diag(lower)).sum())
        return Pairs(chosen, index, np.ascontiguousarray(np.linalg.inv(lower)), volume, *gates)

    def _blind(self, mask: Mask) -> np.ndarray:
        inside = [name in mask for name in self._schema.x_out]
        sizes = [self._schema.layout.signal(name).size for name in self._schema.x_out]
        return ~np.repeat(inside, sizes)

    def _covariance(self, masks: tuple[Mask, ...]) -> np.ndarray:
        """Return the covariance of the errors of all elements under all masks, shape (n, n), n = masks * out_size."""
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
            prediction = schema.infer(self._anchors, mask, self._biases).astype(float)
            known = self._anchor_errors[mask] = self._anchors[:, schema.out_index] - prediction
        return known

    def of(
        self, schema: BodySchema, pairs: Pairs, rows: np.ndarray, biases: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened errors and their derivatives: error(p + dp) = error - derivative dp.

        Args:
            schema: The schema whose W predicts.
            pairs: The errors; every row must have them.
            rows: Samples [standard deviations], shape (rows, size).
            biases: p of every row, shape (rows, bias_size).

        Returns:
            Errors, shape (rows, n), and derivatives, shape (rows, n, bias_size), in float64.
        """
        p = np.ascontiguousarray(biases, np.float32)
        x = np.ascontiguousarray(rows, float)
        return innovations(schema.predictor, x, p, *pairs.parts)


def own_bias(schema: BodySchema, count: int) -> np.ndarray:
    """Return the p of every anchor's own condition, shape (count, bias_size), or the present p."""
    if len(schema.anchor_conditions) == count and schema.biases and count:
        return np.stack(list(schema.biases.values()))[schema.anchor_conditions]
    return np.repeat(schema.bias[None], count, axis=0)
