"""Physical units outside, standard deviations of the training data inside."""

from dataclasses import dataclass, field

import numpy as np

from gemuco.errors import NotEnoughData
from gemuco.signals import Layout

FLOOR = 0.02
"""An element varies at least this share of the liveliest element of its signal, so that the noise of an element that
hardly moved in the training data is not blown up to the size of a motion."""

CLIP = 4.0
"""Network inputs are held within this many standard deviations: outside the data a network has nothing to say."""


CORE = (0.02, 0.98)
"""Quantiles between which an element's usual values lie. What is further outside than these are apart (6 standard
deviations of a normal distribution) may be learned, but has no part in the scale: one wild value must not set it."""


@dataclass(frozen=True, slots=True)
class Scaler:
    """Mean and spread of every element of a layout.

    Attributes:
        mean: Mean [unit], shape (size,).
        std: Standard deviation with a floor [unit], shape (size,).
        low: Smallest usual value in the training data [unit], shape (size,).
        high: Largest usual value in the training data [unit], shape (size,).
        dead: Positions of the elements that never varied or were never measured, shape (n,).
    """

    mean: np.ndarray
    std: np.ndarray
    low: np.ndarray
    high: np.ndarray
    dead: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    @classmethod
    def fit(cls, layout: Layout, rows: np.ndarray) -> "Scaler":
        """Learn the scale from rows [unit], shape (samples, size); NaN or infinite where nothing was measured.

        A dead element gets the mean it was stuck at (0 if it was never measured) and, so that its noise is not blown
        up, the floor of its signal; 1 unit if the whole signal is dead.

        Raises:
            NotEnoughData: There is no row with a number in it.
        """
        if not np.isfinite(rows).any():
            raise NotEnoughData("The training data hold no measured value at all; check what was recorded.")
        mean, std, low, high = (np.zeros(layout.size) for _ in range(4))
        for index in range(layout.size):
            values = _usual(rows[np.isfinite(rows[:, index]), index])
            if len(values):
                mean[index], std[index] = values.mean(), values.std()
                low[index], high[index] = values.min(), values.max()
        dead = np.flatnonzero(high - low <= 1e-9 * np.maximum(np.abs(mean), 1e-3))
        std[dead] = 0.0
        for name in layout.names:
            part = std[layout.slice(name)]
            liveliest = float(part.max())
            np.maximum(part, FLOOR * liveliest if liveliest > 0.0 else 1.0, out=part)
        return cls(mean, std, low, high, dead)

    def normalise(self, values: np.ndarray) -> np.ndarray:
        """Physical units -> standard deviations, shape (..., size)."""
        return (values - self.mean) / self.std

    def restore(self, values: np.ndarray) -> np.ndarray:
        """Standard deviations -> physical units, shape (..., size)."""
        return values * self.std + self.mean


def _usual(values: np.ndarray) -> np.ndarray:
    """The values without those far outside of nearly all others; all of them if nearly all are the same."""
    if len(values) < 2:
        return values
    low, high = np.quantile(values, CORE)
    width = high - low
    return values[(values >= low - width) & (values <= high + width)] if width > 0.0 else values
