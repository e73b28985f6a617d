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
            slope: Whether gradients are wanted; they may be anything if not.
        """
        ...


@dataclass(frozen=True, slots=True)
class Difference:
    """M x - w of one signal's prediction [standard deviations]: scaled, and zero where nothing is asked.

    Attributes:
        what: The beginning of what is said of a reference of another size.
        span: Where the signal lies in the layout.
        matrix: M, shape (rows, n); None for one.
        middle: What is wanted where w is 0 [unit of A x], shape (rows,).
        scale: What is wanted where w is 1 more than that [unit of A x], shape (rows,).
        wanted: w, shape (rows,).
        asked: Which rows count, shape (rows,).
    """

    what: str
    span: slice
    matrix: np.ndarray | None
    middle: np.ndarray
    scale: np.ndarray
    wanted: np.ndarray
    asked: np.ndarray

    @classmethod
    def of(cls, schema: BodySchema, signal: str, matrix: Sequence[Sequence[float]] | None, unit: str) -> "Difference":
        """From the signal's own unit; nothing is asked yet.

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

    def ask(self, reference: np.ndarray) -> "Difference":
        """Want a reference [unit of A x], shape (rows,), in place of the one before; nothing where it is NaN.

        Raises:
            WrongSize: It does not have as many elements as there are rows.
        """
        if reference.shape != self.wanted.shape:
            raise WrongSize(f"{self.what} has shape {reference.shape}.")
        np.subtract(reference, self.middle, out=self.wanted)
        np.divide(self.wanted, self.scale, out=self.wanted)
        np.isfinite(self.wanted, out=self.asked)
        if not self.asked.all():
            self.wanted[~self.asked] = 0.0
        return self

    def at(self, x: np.ndarray) -> np.ndarray:
        """The difference at predictions, shape (candidates, size) -> (candidates, rows)."""
        part = x[:, self.span]
        return ((part if self.matrix is None else part @ self.matrix.T) - self.wanted) * self.asked

    def rows(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """What is asked as rows over the whole layout, shape (asked, size), and what they shall be, shape (asked,)."""
        found = np.zeros((len(self.wanted), size))
        found[:, self.span] = np.eye(len(self.wanted)) if self.matrix is None else self.matrix
        return found[self.asked], self.wanted[self.asked]


def _nothing(rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(rows), np.zeros(rows, bool)


@dataclass(frozen=True, slots=True)
class Norm:
    """weight * ||M x - w|| of a prediction; a `Bound` that compiled searches know (`gemuco.search.fold`)."""

    difference: Difference
    weight: float

    def __call__(self, x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """See `Bound`."""
        difference = self.difference.at(x)
        norm = np.sqrt(np.einsum("ij,ij->i", difference, difference))
        gradient = np.zeros_like(x)
        if slope:
            way = difference * (self.weight / np.maximum(norm, TINY))[:, None]
            matrix = self.difference.matrix
            gradient[:, self.difference.span] = way if matrix is None else way @ matrix
        return self.weight * norm, gradient


def total(bounds: Sequence[Bound], x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Sum of bound terms and its gradient; nothing wanted loses nothing."""
    loss, gradient = np.zeros(len(x), x.dtype), np.zeros_like(x)
    for bound in bounds:
        part, way = bound(x, slope)
        loss = loss + part
        gradient = gradient + way
    return loss, gradient
