"""Statistics of windows of consecutive normal samples: how far the mean of n samples of a healthy body may be off.

Neighbouring samples are alike: the mean of n of them varies more than that of n independent ones. So the statistics of
every n come from windows of n consecutive samples that were not learned from. A body that moves less than in these
windows, or stands still, repeats the same systematic errors: its samples count as the fewer samples over which a moving
body scatters as much.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

LONGEST = 256
"""Windows of at most this number of samples are learned; a longer one is judged by its last samples."""

DISJOINT = 12
"""A length of window needs at least this number of disjoint windows in the normal data."""

CERTAIN = 0.9
"""The promised rate of false alarms is kept with this probability, as far as logarithms of distances are normal."""

SYSTEMATIC = 0.1
"""A mean over a window varies by at least this share of the variance of one sample: under another p, or in another part
of the motion, even a good model is off by a part of its noise."""

PARTS = 5
"""Shifts of the windows in each of this number of parts of the motion are measured by the windows in the others."""

CALM = 0.1
"""A window in which the body moves more than in this share of the normal windows counts in full."""

FEWEST = 8.0
"""Fewer independent samples than this count as this many; the tolerance has no finite value below 5."""


def tolerance(false_alarm: float, independent: float) -> float:
    """Return how many sample standard deviations above the sample mean a normal limit lies.

    Natrella's formula for the one-sided tolerance limit: with the probability `CERTAIN` at most a share `false_alarm`
    of the population lies above, if mean and standard deviation come from `independent` samples.
    """
    count = max(FEWEST, independent)
    z, c = NormalDist().inv_cdf(1.0 - false_alarm), NormalDist().inv_cdf(CERTAIN)
    a, b = 1.0 - c**2 / (2.0 * (count - 1.0)), z**2 - c**2 / count
    return (z + math.sqrt(max(0.0, z**2 - a * b))) / a


def limit(values: np.ndarray, false_alarm: float, independent: float, least: float = 0.0) -> float:
    """Return the limit that values exceed with the probability `false_alarm`, the larger of two.

    One is the tolerance limit of a normal distribution whose standard deviation is not below `least`; the other is the
    observed quantile, for heavy tails.
    """
    normal = values.mean() + tolerance(false_alarm, independent) * max(float(values.std()), least)
    return max(float(np.quantile(values, 1.0 - false_alarm)), float(normal))


def at_most(share: float, independent: float) -> float:
    """Return the rate that is not exceeded with 95 % confidence, from an observed share (Wilson's score interval)."""
    c, n = NormalDist().inv_cdf(0.95), max(1.0, independent)
    middle, half = share + c**2 / (2.0 * n), c * math.sqrt(share * (1.0 - share) / n + c**2 / (4.0 * n**2))
    return min(1.0, (middle + half) / (1.0 + c**2 / n))


def area(ill: np.ndarray, well: np.ndarray) -> float:
    """Return the area under the ROC curve: how often a value of an ill body exceeds that of a healthy one."""
    ordered = np.sort(well)
    below = np.searchsorted(ordered, ill, side="left")
    not_above = np.searchsorted(ordered, ill, side="right")
    return float(np.mean(below + not_above) / (2.0 * len(ordered)))


def means(values: np.ndarray, count: int) -> np.ndarray:
    """Return the means of all windows of `count` consecutive rows, shape (n, ...) -> (n - count + 1, ...)."""
    summed = np.cumsum(np.concatenate([np.zeros_like(values[:1]), values]), axis=0)
    return np.asarray((summed[count:] - summed[:-count]) / count)


def correlation_time(values: np.ndarray) -> float:
    """Return the number of consecutive samples that are worth one independent sample, shape (n,) -> at least 1."""
    time, count = 1.0, 2
    while count <= len(values) // DISJOINT:
        time = max(time, count * float(means(values, count).var()) / max(float(values.var()), 1e-12))
        count *= 2
    return time


def _shifts(moved: np.ndarray) -> np.ndarray:
    """Return the mean squared shift of every window, as a multiple of that of windows in other parts of the motion.

    Args:
        moved: Mean errors over windows, oldest first, shape (n, errors).
    """
    shifts = []
    for part in np.array_split(np.arange(len(moved)), PARTS):
        others = np.delete(moved, part, axis=0)
        center, spread = others.mean(axis=0), np.maximum(others.var(axis=0), SYSTEMATIC)
        shifts.append(((moved[part] - center) ** 2 / spread).mean(axis=1))
    return np.concatenate(shifts)


def _scatters(samples: np.ndarray, count: int) -> np.ndarray:
    """Return the usual variance of every element within windows, shape (n, size) -> (size,).

    It is the mean over the windows, times a factor by which the sum over the elements becomes that of a calm window.
    """
    known = np.isfinite(samples).all(axis=0)
    usual = np.full(samples.shape[1], np.nan)
    within = (means(samples[:, known] ** 2, count) - means(samples[:, known], count) ** 2).clip(min=0.0)
    total = within.sum(axis=1)
    usual[known] = within.mean(axis=0) * float(np.quantile(total, CALM)) / max(float(total.mean()), 1e-12)
    return usual


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Limits of windows of n samples of a healthy body.

    Attributes:
        sizes: Learned n, ascending, shape (levels,).
        limits: Limit of the mean deviation of a window, shape (levels,).
        stds: Standard deviation of the mean deviation of normal windows, shape (levels,).
        variance: Variance of the mean of every error over a window [its single variance], shape (levels, errors).
        shift: Limit of the logarithm of the mean squared shift, a multiple of this variance, shape (levels,).
        shift_stds: Standard deviation of this logarithm in normal windows, shape (levels,).
        scatter: Variance of every element within a window in which the body moves little [standard deviations of the
            training data], shape (levels, size), NaN if not known; None in older models, where all windows count in
            full.
    """

    sizes: np.ndarray
    limits: np.ndarray
    stds: np.ndarray
    variance: np.ndarray
    shift: np.ndarray
    shift_stds: np.ndarray
    scatter: np.ndarray | None = None

    @classmethod
    def fit(
        cls, deviations: np.ndarray, errors: np.ndarray, false_alarm: float, samples: np.ndarray | None = None
    ) -> "Windows":
        """Learn from consecutive normal samples.

        Args:
            deviations: Deviation of every sample, shape (n,).
            errors: Its errors [their standard deviations], mean zero, shape (n, errors).
            false_alarm: Share of normal windows that may be above a limit.
            samples: Its values [standard deviations of the training data], shape (n, size).
        """
        time = correlation_time(deviations)
        sizes, variance = [], []
        limits: list[tuple[float, float]] = []
        shifts: list[tuple[float, float]] = []
        count = 1
        while count <= max(1, min(LONGEST, len(deviations) // DISJOINT)):
            independent = len(deviations) / max(time, count)
            moved = means(errors, count)
            share = false_alarm if count == 1 else false_alarm / 2.0
            sizes.append(count)
            variance.append(np.maximum((moved**2).mean(axis=0), SYSTEMATIC))
            for values, least, known in (
                (means(deviations, count), math.sqrt(SYSTEMATIC) * float(deviations.std()), limits),
                (np.log(_shifts(moved) + 1e-12), 1e-6, shifts),
            ):
                known.append((limit(values, share, independent, least), max(float(values.std()), least)))
            count *= 2
        above, shifted = np.array(limits), np.array(shifts)
        scatter = None if samples is None else np.array([_scatters(samples, count) for count in sizes])
        return cls(np.array(sizes), above[:, 0], above[:, 1], np.array(variance), shifted[:, 0], shifted[:, 1], scatter)

    @property
    def longest(self) -> int:
        """Number of samples that are judged; only the last ones of a longer window are."""
        return int(self.sizes[-1])

    def place(self, count: int, samples: np.ndarray) -> float:
        """Return the logarithm to base 2 of the number of samples that a window counts as.

        Args:
            count: Number of its judged samples.
            samples: Their values [standard deviations of the training data], shape (count, size), NaN where not
                measured.
        """
        whole = math.log2(min(count, self.longest))
        if self.scatter is None or count < 2:
            return whole
        known = np.isfinite(samples).all(axis=0) & np.isfinite(self.scatter[-1])
        usual = np.maximum.accumulate(self.scatter[:, known].sum(axis=1))
        moved = float(samples[:, known].var(axis=0).sum())
        level = max(1, int(np.searchsorted(usual, moved, side="right")))
        if level >= len(usual):
            return whole
        return min(whole, max(0.0, level - 1 + (moved - usual[level - 1]) / (usual[level] - usual[level - 1])))

    def excess(self, deviations: np.ndarray, place: float) -> float:
        """Return how far the mean deviation of a window is above its limit [its standard deviations].

        Args:
            deviations: Deviations of the samples, shape (n,).
            place: Its `place`.
        """
        above = deviations.mean() - self._at(place, self.limits)
        return float(above / self._at(place, self.stds))

    def shifted(self, errors: np.ndarray, place: float) -> float:
        """Return how far the shift of a window is above its limit [its standard deviations].

        A single sample has no shift of its own: negative infinity.

        Args:
            errors: Errors of the samples [their standard deviations], shape (n, errors).
            place: Its `place`.
        """
        if len(errors) < 2 or len(self.sizes) < 2:
            return -math.inf
        ratio = errors.mean(axis=0) ** 2 / self._at(place, self.variance)
        above = np.log(ratio.mean() + 1e-12) - self._at(place, self.shift)
        return float(above / self._at(place, self.shift_stds))

    @staticmethod
    def _at(place: float, values: np.ndarray) -> np.ndarray:
        """Return values between two learned sizes, linear in the logarithm of the size."""
        low = int(place)
        high = min(low + 1, len(values) - 1)
        return np.asarray(values[low] + (place - low) * (values[high] - values[low]))
