"""Bound terms (`gemuco.search.losses`): losses of predictions. Most are norms of a linear function of a prediction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gemuco.errors import WrongSize
from gemuco.schema import BodySchema

TINY = 1e-9


class Bound(Protocol):
    """A term bound to a schema, references and present values: a function of predictions."""

    def __call__(self, x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Return losses, shape (candidates,), and their gradients, shape (candidates, size).

        Args:
            x: Predictions [standard deviations], shape (candidates, size).
            slope: Whether gradients are needed; if not, their values are undefined.
        """
        ...


@dataclass(frozen=True, slots=True)
class Difference:
    """Scaled difference M x - w between a signal's prediction and its reference; 0 in rows without a reference.

    Attributes:
        what: First words of the message about a reference of the wrong size.
        span: Slice of the signal in the layout.
        matrix: M, shape (rows, n); None for the identity.
        middle: Reference at which w is 0 [unit of A x], shape (rows,).
        scale: Change of the reference that changes w by 1 [unit of A x], shape (rows,).
        reference: w, shape (rows,).
        counts: Whether each row has a reference, shape (rows,).
    """

    what: str
    span: slice
    matrix: np.ndarray | None
    middle: np.ndarray
    scale: np.ndarray
    reference: np.ndarray
    counts: np.ndarray

    @classmethod
    def of(cls, schema: BodySchema, signal: str, matrix: Sequence[Sequence[float]] | None, unit: str) -> "Difference":
        """Make the difference of a signal, without a reference.

        Raises:
            UnknownSignal: The signal is not in the layout.
            WrongSize: The matrix does not fit the signal.
        """
        span = schema.layout.slice(signal)
        mean, std = schema.scaler.mean[span], schema.scaler.std[span]
        if matrix is None:
            what = f"Signal '{signal}' has {len(std)} elements, but the array"
            scale = std if unit == "std" else np.ones_like(std)
            return cls(what, span, None if unit == "std" else np.diag(std), mean, scale, *_no_reference(len(std)))
        try:
            rows = np.array(matrix, float)
        except ValueError:
            rows = np.zeros(0)
        if rows.ndim != 2 or rows.shape[1] != len(std):
            raise WrongSize(f"The matrix of '{signal}' needs {len(std)} columns in every row.")
        scale = np.maximum(np.sqrt(rows**2 @ std**2), TINY) if unit == "std" else np.ones(len(rows))
        what = f"The matrix of '{signal}' has {len(rows)} rows, but its reference"
        return cls(what, span, rows * std / scale[:, None], rows @ mean, scale, *_no_reference(len(rows)))

    def take(self, reference: np.ndarray) -> "Difference":
        """Use another reference [unit of A x], shape (rows,); NaN for rows without a reference.

        Raises:
            WrongSize: The reference does not have one element per row.
        """
        if reference.shape != self.reference.shape:
            raise WrongSize(f"{self.what} has shape {reference.shape}.")
        np.subtract(reference, self.middle, out=self.reference)
        np.divide(self.reference, self.scale, out=self.reference)
        np.isfinite(self.reference, out=self.counts)
        if not self.counts.all():
            self.reference[~self.counts] = 0.0
        return self

    def at(self, x: np.ndarray) -> np.ndarray:
        """Return the difference at predictions, shape (candidates, size) -> (candidates, rows)."""
        part = x[:, self.span]
        return ((part if self.matrix is None else part @ self.matrix.T) - self.reference) * self.counts

    def rows(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows with a reference, over the whole layout, shape (rows, size), and their w, shape (rows,)."""
        rows = np.zeros((len(self.reference), size))
        rows[:, self.span] = np.eye(len(self.reference)) if self.matrix is None else self.matrix
        return rows[self.counts], self.reference[self.counts]


def _no_reference(rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(rows), np.zeros(rows, bool)


@dataclass(frozen=True, slots=True)
class Norm:
    """weight * ||M x - w|| of a prediction; a `Bound` that compiled searches support (`gemuco.search.fold`)."""

    difference: Difference
    weight: float

    def __call__(self, x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Return losses and gradients; see `Bound`."""
        difference = self.difference.at(x)
        norm = np.sqrt(np.einsum("ij,ij->i", difference, difference))
        gradient = np.zeros_like(x)
        if slope:
            slopes = difference * (self.weight / np.maximum(norm, TINY))[:, None]
            matrix = self.difference.matrix
            gradient[:, self.difference.span] = slopes if matrix is None else slopes @ matrix
        return self.weight * norm, gradient


def total(bounds: Sequence[Bound], x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return the sum of bound terms and its gradient; 0 without terms."""
    loss, gradient = np.zeros(len(x), x.dtype), np.zeros_like(x)
    for bound in bounds:
        part, slopes = bound(x, slope)
        loss = loss + part
        gradient = gradient + slopes
    return loss, gradient
