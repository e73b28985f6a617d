"""Physical units outside, standard deviations of the training data inside."""

from dataclasses import dataclass, field

import numpy as np

from gemuco.errors import NotEnoughData
from gemuco.signals import Layout

FLOOR = 0.02
"""The standard deviation of an element is at least this share of the largest in its signal. Otherwise the noise of an
element that hardly moved in the training data would be scaled up to the size of a motion."""

CLIP = 4.0
"""Network inputs are clipped to this many standard deviations: outside its training data a network is useless."""

CORE = (0.02, 0.98)
"""The scale of an element is computed without outliers: values that lie further outside these quantiles than the
distance between them (6 standard deviations from the mean of a normal distribution). They may still be learned."""


@dataclass(frozen=True, slots=True)
class Scaler:
    """Mean and spread of every element of a layout.

    Attributes:
        mean: Mean [unit], shape (size,).
        std: Standard deviation with a floor [unit], shape (size,).
        low: Smallest usual value in the training data [unit], shape (size,).
        high: Largest usual value in the training data [unit], shape (size,).
        dead: Positions of elements that never varied or were never measured, shape (n,).
    """

    mean: np.ndarray
    std: np.ndarray
    low: np.ndarray
    high: np.ndarray
    dead: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    @classmethod
    def fit(cls, layout: Layout, rows: np.ndarray) -> "Scaler":
        """Compute the scale of rows [unit], shape (samples, size); NaN or infinite where nothing was measured.

        The mean of a dead element is its constant value, or 0 if it was never measured. Its standard deviation is the
        floor of its signal, so that its noise is not scaled up, or 1 unit if the whole signal is dead.

        Raises:
            NotEnoughData: No row contains a finite number.
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
            largest = float(part.max())
            np.maximum(part, FLOOR * largest if largest > 0.0 else 1.0, out=part)
        return cls(mean, std, low, high, dead)

    def normalise(self, values: np.ndarray) -> np.ndarray:
        """Convert physical units to standard deviations, shape (..., size)."""
        return (values - self.mean) / self.std

    def restore(self, values: np.ndarray) -> np.ndarray:
        """Convert standard deviations to physical units, shape (..., size)."""
        return values * self.std + self.mean


def _usual(values: np.ndarray) -> np.ndarray:
    """Return the values without outliers (see `CORE`); all values if nearly all are the same."""
    if len(values) < 2:
        return values
    low, high = np.quantile(values, CORE)
    width = high - low
    return values[(values >= low - width) & (values <= high + width)] if width > 0.0 else values
