"""Errors of a schema on samples of the body as it is."""

from collections.abc import Sequence

import numpy as np

from gemuco.adaption.renewal import Renewal
from gemuco.masks import Mask
from gemuco.schema import BodySchema, ErrorTable

FORGET = 0.01
"""The newest sample has at least this share of the mean error."""
TRUST = 5
"""The errors of the training count as this many samples."""

EXPLAINED = 2.0
"""A p explains what is seen if the errors are at most this many times as large as learned."""
LEAST = 1e-6
"""A learned mean square below this counts as this [standard deviations squared]."""

Squares = dict[Mask, np.ndarray]
"""Mask -> mean squared error of every x_out element [standard deviations squared], shape (out_size,)."""


class SeenErrors:
    """Mean squared errors of a schema under every mask, beginning with those of the training.

    The error of a sample must be measured before the sample is learned from.

    Args:
        schema: The schema to begin with.
    """

    def __init__(self, schema: BodySchema) -> None:
        self._first = schema
        self._squares = expected_squares(schema)
        self._count = 0
        self._renewal = Renewal(schema)

    def see(self, schema: BodySchema, x: np.ndarray) -> None:
        """Measure the prediction of a sample [standard deviations], shape (size,), under all masks that it covers."""
        whole, data = schema.layout.whole(np.isfinite(x)), x[schema.out_index]
        self._count += 1
        share = max(FORGET, 1.0 / (TRUST + self._count))
        for m in schema.masks:
            if m <= whole:
                squared = (schema.infer(x, m) - data) ** 2
                known = self._squares.setdefault(m, squared)
                self._squares[m] = np.where(np.isfinite(squared), known + share * (squared - known), known)
                self._renewal.see(schema, x, m, squared, share)

    def renewed(self, schema: BodySchema, unseen: np.ndarray | None = None, excess: float = 1.0) -> BodySchema:
        """Return a schema with the expected errors and the certainty as they are now.

        The errors were measured with its p, so the uncertainty of p counts less with every sample.

        Args:
            schema: The schema.
            unseen: Whether each element was not measured since the body changed, shape (size,).
            excess: See `Certainty`.
        """
        squares = dict(self._squares)
        if excess > EXPLAINED:  # no sample of a body that changed just now is in the means
            for m, learned in expected_squares(self._first).items():
                squares[m] = np.maximum(squares[m], excess**2 * learned)
        schema = schema.with_weights(schema.weights, with_squares(self._first, squares))
        certainty = self._renewal.certainty()
        if certainty is None or schema.certainty is None:
            return schema
        covariance = schema.certainty.covariance
        if covariance is not None:
            covariance = covariance * (TRUST / (TRUST + self._count))
        return schema.with_certainty(certainty.at(covariance, unseen, excess))


def excess(first: BodySchema, schema: BodySchema, rows: np.ndarray) -> float:
    """Return the errors of a schema on samples as a share of those learned (root of the median over the samples).

    Signals that a mask contains do not count: the network copies them whatever p is.

    Args:
        first: The schema whose expected errors are those learned.
        schema: The schema that predicts.
        rows: Samples [standard deviations], shape (n, size), NaN where not measured.
    """
    expected, total, count = expected_squares(first), np.zeros(len(rows)), np.zeros(len(rows))
    for m in expected:
        whole = np.isfinite(rows[:, schema.layout.indices(m)]).all(axis=1)
        blind = np.array([s.name not in m for s in schema.out_layout.signals for _ in range(s.size)])
        if not whole.any() or not blind.any():
            continue
        missed = schema.infer(rows[whole], m)[:, blind] - rows[whole][:, schema.out_index[blind]]
        ratio = missed**2 / np.maximum(expected[m][blind], LEAST)
        total[whole] += np.nansum(ratio, axis=1)
        count[whole] += np.isfinite(ratio).sum(axis=1)
    judged = count > 0
    return float(np.sqrt(np.median(total[judged] / count[judged]))) if judged.any() else 1.0


def expected_squares(schema: BodySchema) -> Squares:
    """Return the squares of a schema's expected errors of masks."""
    scale = schema.scaler.std[schema.out_index]
    return {m: (schema.errors[key] / scale) ** 2 for m in schema.masks if (key := ("mask", m)) in schema.errors}


def sample_errors(schema: BodySchema, rows: np.ndarray) -> Squares:
    """Return the squared errors of single samples under every mask that some of them cover.

    Args:
        schema: The schema with the p of the samples.
        rows: Samples [standard deviations], shape (n, size), NaN where not measured.

    Returns:
        Mask -> squared errors [standard deviations squared], shape (samples, out_size), NaN where not measured.
    """
    squares: Squares = {}
    for m in schema.masks:
        whole = np.isfinite(rows[:, schema.layout.indices(m)]).all(axis=1)
        if whole.any():
            squares[m] = (schema.infer(rows[whole].astype(float), m) - rows[whole][:, schema.out_index]) ** 2
    return squares


def mean_squares(parts: Sequence[Squares]) -> Squares:
    """Return the mean over all samples of several parts, shape (out_size,); 1 where none was measured."""
    masks = dict.fromkeys(m for part in parts for m in part)
    errors = {m: np.concatenate([part[m] for part in parts if m in part]) for m in masks}
    counts = {m: np.isfinite(error).sum(axis=0) for m, error in errors.items()}
    return {m: np.where(counts[m] > 0, np.nansum(e, axis=0) / np.maximum(counts[m], 1), 1.0) for m, e in errors.items()}


def with_squares(schema: BodySchema, squares: Squares) -> ErrorTable:
    """Return the schema's table of expected errors with other errors of the masks.

    The errors of searches grow or shrink as those of the masks do, element by element; that of an element outside x_out
    as their mean.
    """
    table = dict(schema.errors)
    table |= {("mask", m): np.sqrt(part) * schema.scaler.std[schema.out_index] for m, part in squares.items()}
    before = expected_squares(schema)
    both = [m for m in before if m in squares]
    if both:
        ratio = np.sum([squares[m] for m in both], axis=0) / np.sum([before[m] + 1e-12 for m in both], axis=0)
        factor = np.full(schema.layout.size, np.sqrt(ratio.mean()))
        factor[schema.out_index] = np.sqrt(ratio)
        for (method, given), error in schema.errors.items():
            if method == "latent":
                table[method, given] = error * factor[schema.out_index]
            elif method == "input":
                table[method, given] = error * factor
    return table
