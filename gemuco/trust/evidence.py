"""Evidence against every judged column, as a share of what a healthy body reaches once per allowed false alarm."""

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from gemuco.trust.changes import AGES, LastingTest, StepTest
from gemuco.trust.config import BLOCK
from gemuco.trust.healthy import Healthy
from gemuco.trust.recent import JERKS, NOISY, SETTLING, View

NOISE = 8.0
"""A burst of noise has at least this multiple of the healthy variance, more if it is known from few samples."""
BENDS = 1.94
"""This number of second differences of white noise says as much of its variance as one independent value."""
RECENT = 20
"""The usual error is that of this number of blocks."""
NEWEST = 5
"""At rest, the mean of this number of the newest errors is held against those when the body had settled."""
LATELY, SLOWLY = 15, 0.5
"""A change is slow if within the first number of blocks the error has changed by less than the second share of it."""
QUIET = 0.7
"""Its standard deviation is at least this share of the size of a lie that matters."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Results of all tests of one view, arrays of shape (columns,).

    Attributes:
        ratio: Largest evidence of any test; from 1 on it is an alarm. Zero for hidden columns.
        strength: Logarithm of the likelihood ratio of the strongest test.
        age: Age of the most likely change [blocks].
        step: Result of the step test [standard deviations].
        is_noise: Whether noise is the strongest evidence.
        is_slow: Whether the body rests and the error has changed so slowly since that no other tool explains it.
        level: Usual error of the columns that are not hidden [that of this body while it was healthy], a scalar.
    """

    ratio: np.ndarray
    strength: np.ndarray
    age: np.ndarray
    step: np.ndarray
    is_noise: np.ndarray
    is_slow: np.ndarray
    level: float

    @property
    def highest(self) -> float:
        """Largest evidence against any column."""
        return self.highest_of(slice(None))

    def highest_of(self, columns: slice) -> float:
        """Return the largest evidence against some columns."""
        return float(self.ratio[columns].max(initial=0.0))

    @property
    def newest(self) -> int:
        """Age of the most likely change of the column with the most evidence [blocks]."""
        return int(self.age.flat[self.strength.argmax()])


class Judge:
    """Limits and tests for the body as it is."""

    def __init__(self, healthy: Healthy, false_alarms: float, least: np.ndarray) -> None:
        """Prepare.

        Args:
            healthy: What is known of the errors of this body.
            false_alarms: Allowed wrong verdicts per hour.
            least: Size of a lie that matters [errors of a healthy prediction], shape (columns,).
        """
        chance = false_alarms * BLOCK / 3600.0 / len(least)
        self.scale, self.least = healthy.scale, np.maximum(1.0, healthy.tail / 0.4) * least
        likeness = healthy.likeness
        self.time = likeness.time
        self._steps, self._limit = StepTest(likeness), np.maximum(healthy.limit(chance), least)
        self._sum, self._likeness, self._size = -math.log(chance), likeness, least
        self._noise = np.maximum(NOISE * healthy.noise, (QUIET * least * self.scale) ** 2)
        self._chance = chance

    def __call__(self, view: View, lasting: LastingTest | None = None) -> Evidence:
        """Return the evidence in a view; without `lasting` from its blocks alone."""
        step, best = self._steps(view.standard(self.scale), view.moved)
        ratio, strength, age = step / self._limit, 0.5 * step**2, np.array(AGES)[best]
        if lasting is not None:
            likelihood = lasting.likelihood
            is_longer = likelihood / self._sum > ratio
            ratio = np.where(is_longer, likelihood / self._sum, ratio)
            strength = np.maximum(strength, likelihood)
            age = np.where(is_longer, AGES[-1], age)
        rest, is_slow = self._at_rest(view)
        is_rest = rest > ratio
        ratio, age = np.where(is_rest, rest, ratio), np.where(is_rest, AGES[-1], age)
        strength = np.maximum(strength, 0.5 * (rest * self._limit) ** 2)
        noise = np.nan_to_num(view.noise) / self._noise * min(1.0, NOISE / burst(view.samples, self._chance))
        is_noise = (noise >= 1.0) & (np.sqrt(noise) > ratio)
        ratio = np.where(is_noise, np.sqrt(noise), ratio)
        strength = np.where(is_noise, 10.0 * noise, strength)
        hidden = list(view.hidden)
        ratio[hidden] = strength[hidden] = 0.0
        return Evidence(ratio, strength, age, step, is_noise, is_rest & is_slow, _level(view, self.scale))

    def _at_rest(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return the evidence in errors that change while the body rests, 0 in motion; and whether they change slowly.

        The slow part of the errors is that of the posture, so as good as none of it changes. Shapes (columns,).
        """
        newest = view.z[-NEWEST:].mean(axis=0)
        change = np.nan_to_num(np.abs(newest - view.settled) / self.scale)
        lately = np.abs(newest - view.z[-LATELY : NEWEST - LATELY].mean(axis=0)) / self.scale
        slow, white = self._likeness.slow, self._likeness.white
        posture = self._limit**2 * 2.0 * (1.0 - white) * (1.0 - slow**view.away)
        noise = 2.0 * self._sum * white * (1.0 / SETTLING + 1.0 / NEWEST)  # normal, so without a tail
        return change / np.maximum(np.sqrt(posture + noise), self._size), lately < SLOWLY * change


@lru_cache
def burst(samples: int, chance: float) -> float:
    """Return the multiple of the healthy variance that healthy noise reaches with this chance.

    Noise is the median of `NOISY` blocks with this number of samples, so most of them reach it. A share `JERKS` of the
    noise of the prediction, which is half of all where both are alike, has been taken off. By the approximation of
    Wilson and Hilferty for chi squared.
    """
    freedom, most = max(samples - 2, 1) / BENDS, NOISY // 2 + 1
    quantile = NormalDist().inv_cdf(1.0 - (chance / math.comb(NOISY, most)) ** (1.0 / most))
    variance = 2.0 / (9.0 * freedom)
    return (1.0 - variance + quantile * math.sqrt(variance)) ** 3 / (1.0 - 0.5 * JERKS)


def _level(view: View, scale: np.ndarray) -> float:
    """Return the median over the columns in use of the root mean square error of the newest blocks; 0 if unknown.

    It is in units of `scale`, the standard deviation of the errors on this body, shape (columns,).
    """
    used = np.ones(view.z.shape[1], bool)
    used[list(view.hidden)] = False
    z = view.standard(scale)[:, used][-RECENT:]
    z = z[np.isfinite(z).all(axis=1)]
    return float(np.median(np.sqrt(np.mean(z**2, axis=0)))) if z.size else 0.0
