"""Physical units outside, standard deviations of the training data inside."""

from dataclasses import dataclass

import numpy as np

from gemuco.errors import NotEnoughData
from gemuco.signals import Layout

FLOOR = 0.02
"""An element varies at least this share of the liveliest element of its signal, so that the noise of an element that
hardly moved in the training data is not blown up to the size of a motion."""

CLIP = 4.0
"""Network inputs are held within this many standard deviations: outside the data a network has nothing to say."""


@dataclass(frozen=True, slots=True)
class Scaler:
    """Mean and spread of every element of a layout.

    Attributes:
        mean: Mean [unit], shape (size,).
        std: Standard deviation with a floor [unit], shape (size,).
        low: Smallest value in the training data [unit], shape (size,).
        high: Largest value in the training data [unit], shape (size,).
    """

    mean: np.ndarray
    std: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def fit(cls, layout: Layout, rows: np.ndarray) -> "Scaler":
        """Learn the scale from rows [unit], shape (samples, size); NaN where nothing was measured.

        Raises:
            NotEnoughData: An element was measured less than twice.
        """
        for index in np.flatnonzero(np.isfinite(rows).sum(axis=0) < 2):
            raise NotEnoughData(f"'{layout.element(int(index))}' was measured less than twice in the training data.")
        std = np.nanstd(rows, axis=0)
        for name in layout.names:
            part = std[layout.slice(name)]
            np.maximum(part, max(FLOOR * float(part.max()), 1e-9), out=part)
        return cls(np.nanmean(rows, axis=0), std, np.nanmin(rows, axis=0), np.nanmax(rows, axis=0))

    def normalise(self, values: np.ndarray) -> np.ndarray:
        """Physical units -> standard deviations, shape (..., size)."""
        return (values - self.mean) / self.std

    def restore(self, values: np.ndarray) -> np.ndarray:
        """Standard deviations -> physical units, shape (..., size)."""
        return values * self.std + self.mean
