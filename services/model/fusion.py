"""Combination of a noisy measurement with its estimate from the other signals, by their variances."""

from functools import partial
from typing import NamedTuple

import numpy as np

from gemuco.derived import ByPattern
from gemuco.estimation import Recipe, fill
from gemuco.intervals.sureness import KNOWN
from gemuco.schema import BodySchema

MEMORY = 200
"""The noise is a mean over about this many samples."""
LEAST = 50
"""An element needs this many samples before it is fused."""
AGREE = 3.0
"""A measurement is fused only if it differs from the estimate by at most this many std of the difference."""
MEAN_OF_NORMAL = np.sqrt(2.0 / np.pi)
"""This is the mean absolute value of a normal variable of std 1."""


class Noise:
    """Noise of measured elements, from second differences of successive samples.

    A motion that is smooth over three samples has a second difference near 0, so what is left is the noise of the
    sensor. It is too small for a sensor that is slower than the samples, and then the measurement counts more.

    Args:
        size: Number of elements.

    Attributes:
        std: Standard deviation of the noise [unit of each element], shape (size,); NaN before `LEAST` samples.
    """

    def __init__(self, size: int) -> None:
        self._before, self._last = np.full(size, np.nan), np.full(size, np.nan)
        self._mean, self._count = np.zeros(size), np.zeros(size, int)
        self.std = np.full(size, np.nan)

    def see(self, joined: np.ndarray) -> None:
        """Take the next sample [unit of each element], shape (size,), NaN where not measured."""
        second = np.abs(joined - 2.0 * self._last + self._before) / np.sqrt(6.0)
        known = np.isfinite(second)
        self._count[known] += 1
        share = 1.0 / np.minimum(self._count[known], MEMORY)
        self._mean[known] += share * (second[known] - self._mean[known])
        self._before, self._last = self._last, joined
        self.std = np.where(self._count >= LEAST, self._mean / MEAN_OF_NORMAL, np.nan)


class Fused(NamedTuple):
    """A sample in which measurements are combined with estimates.

    Attributes:
        value: Every element [its unit], shape (size,).
        std: Its std [unit], shape (size,).
        is_fused: Whether each element was fused, shape (size,).
    """

    value: np.ndarray
    std: np.ndarray
    is_fused: np.ndarray


class Fusion:
    """The fusion of successive samples; for one thread.

    Args:
        size: Number of elements of the layout.
    """

    def __init__(self, size: int) -> None:
        self.noise = Noise(size)
        self._recipes: tuple[BodySchema, ByPattern[Recipe]] | None = None

    def fuse(
        self, schema: BodySchema, joined: np.ndarray, value: np.ndarray, std: np.ndarray, factor: np.ndarray | None
    ) -> Fused:
        """Fuse the measured elements of one new sample that a mask without their signal predicts.

        Args:
            schema: The body schema.
            joined: The sample [unit of each element], shape (size,), NaN where not measured.
            value: Its completion; see `gemuco.estimation.Completion`.
            std: The std of the completion, with the factors.
            factor: Factors on the std of estimates, shape (size,), if there are any.
        """
        self.noise.see(joined)
        value, std, is_fused = value.copy(), std.copy(), np.zeros(len(value), bool)
        for name in schema.x_out:
            span = schema.layout.slice(name)
            hidden = joined.copy()
            hidden[span] = np.nan
            hidden.setflags(write=False)
            recipe = self._recipes_of(schema)(np.isfinite(hidden))
            if recipe.method[name] != "mask":
                continue
            other = fill(schema, hidden, recipe)
            if other.sureness[name].state != KNOWN:
                continue
            predicted, own = (other.std if factor is None else other.std * factor)[span] ** 2, self.noise.std[span] ** 2
            difference = joined[span] - other.value[span]
            fits = np.abs(difference) <= AGREE * np.sqrt(predicted + own)  # false where one is not known
            weight = np.where(fits, own / np.where(fits, predicted + own, 1.0), 0.0)
            value[span] = np.where(fits, joined[span] - weight * difference, value[span])
            std[span] = np.where(fits, np.sqrt(weight * np.where(fits, predicted, 0.0)), std[span])
            is_fused[span] = fits
        return Fused(value, std, is_fused)

    def _recipes_of(self, schema: BodySchema) -> ByPattern[Recipe]:
        kept = self._recipes
        if kept is None or kept[0] is not schema:
            kept = self._recipes = schema, ByPattern(partial(Recipe.of, schema))
        return kept[1]
