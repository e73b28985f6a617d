"""Bound terms (`gemuco.search.losses`): losses of predictions, most of them a norm of something linear in them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gemuco.errors import WrongSize
from gemuco.schema import BodySchema

TINY = 1e-9


class Bound(Protocol):
    """A term bound to a schema, references and the present: a function of predictions."""

    def __call__(self, x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Losses, shape (candidates,), and their gradients, shape (candidates, size).

        Args:
            x: Predictions [standard deviations], shape (candidates, size).
            slope: Whether gradients are needed; without, they may be anything.
        """
        ...


@dataclass(frozen=True, slots=True)
class Difference:
    """M x - w of one signal's prediction [standard deviations]: scaled, and zero in rows that do not count.

    Attributes:
        what: The beginning of the message about a reference of another size.
        span: Place of the signal in the layout.
        matrix: M, shape (rows, n); None for the identity.
        middle: Reference at which w is 0 [unit of A x], shape (rows,).
        scale: Change of the reference that changes w by 1 [unit of A x], shape (rows,).
        reference: w, shape (rows,).
        counts: Whether each row counts, shape (rows,).
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
        """Make the difference of a signal; no row counts yet.

        Raises:
            UnknownSignal: The signal is not in the layout.
            WrongSize: The matrix does not fit the signal.
        """
        span = schema.layout.slice(signal)
        mean, std = schema.scaler.mean[span], schema.scaler.std[span]
        if matrix is None:
            what = f"Signal '{signal}' has {len(std)} elements, but the array"
            scale = std if unit == "std" else np.ones_like(std)
            return cls(what, span, None if unit == "std" else np.diag(std), mean, scale, *_nothing(len(std)))
        try:
            rows = np.array(matrix, float)
        except ValueError:
            rows = np.zeros(0)
        if rows.ndim != 2 or rows.shape[1] != len(std):
            raise WrongSize(f"The matrix of '{signal}' needs {len(std)} columns in every row.")
        scale = np.maximum(np.sqrt(rows**2 @ std**2), TINY) if unit == "std" else np.ones(len(rows))
        what = f"The matrix of '{signal}' has {len(rows)} rows, but its reference"
        return cls(what, span, rows * std / scale[:, None], rows @ mean, scale, *_nothing(len(rows)))

    def take(self, reference: np.ndarray) -> "Difference":
        """Take another reference [unit of A x], shape (rows,); a row does not count where it is NaN.

        Raises:
            WrongSize: It does not have as many elements as there are rows.
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
        """Return the counting rows over the whole layout, shape (rows, size), and their references, shape (rows,)."""
        rows = np.zeros((len(self.reference), size))
        rows[:, self.span] = np.eye(len(self.reference)) if self.matrix is None else self.matrix
        return rows[self.counts], self.reference[self.counts]


def _nothing(rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(rows), np.zeros(rows, bool)


@dataclass(frozen=True, slots=True)
class Norm:
    """weight * ||M x - w|| of a prediction; a `Bound` that compiled searches know (`gemuco.search.fold`)."""

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
    """Return the sum of bound terms and its gradient; the sum of no term is 0."""
    loss, gradient = np.zeros(len(x), x.dtype), np.zeros_like(x)
    for bound in bounds:
        part, slopes = bound(x, slope)
        loss = loss + part
        gradient = gradient + slopes
    return loss, gradient
