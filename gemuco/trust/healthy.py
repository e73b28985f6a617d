"""Errors of the body as it is, learned while nothing is suspected: their scale, likeness, steps and noise."""

import math

import numpy as np

from gemuco.trust.changes import LONGEST, Likeness

MEMORY = 600.0
"""Averages forget with this number of blocks."""
TAIL_MEMORY = 6000.0
"""The largest steps are remembered for this number of blocks."""
APART = 5
"""The slow part of the errors follows from blocks that are this far apart."""
SCALES = (0.3, 20.0)
"""The errors on this body are at least and at most this multiple of those that were learned."""
LEAST_PACE = 0.03
"""The usual pace of motion is at least this [standard deviations per block]."""
PRIOR = 100.0
"""What is assumed at the start counts as this number of blocks."""
COMMON, EXCEEDS = 3.0, 0.015
"""A healthy body's step test exceeds `COMMON` standard deviations in at most about this share of the blocks."""
DOUBTED = 0.2
"""Beyond it errors teach the scale by this share only, because a drift would pass as healthy before it is noticed."""
TOGETHER = 4.0
"""Blocks with a large step come in groups of about this number, each of which would be one false alarm."""
TAIL, EXCESSES = 0.4, 20.0
"""Mean excess above `COMMON` that is assumed at the start, and the number of excesses that this counts as."""
TAILS = (0.3, 0.7)
"""The mean excess is at least and at most this; 0.28 for normal errors."""
CAREFUL, MOST_CAREFUL, FORGETS = 3.0, 30.0, 36000.0
"""Each time that elements were hidden and then agreed again, without a sign that they had lied, this multiple of the
evidence is needed from then on, up to the second number; it is forgotten in this number of blocks. Contacts contradict
what was learned too, for a while."""
NOISE_KNOWN = 20
"""The usual noise of a column is known after this number of blocks in which it was measured."""
LATE, SEEN, LATENESS = 0.4, 30.0, (0.05, 4.0)
"""Values of two signals are assumed to be apart by the first multiple of `TIMING`, without a usual lag, which counts as
the second number of blocks. The multiple is at least and at most the third pair, as a lag is at most."""
VARIES = 0.25
"""Values are apart by this share of their lag besides: delays vary, and a velocity changes within a block."""
CLEAR = 9.0
"""The square of one error counts as at most this multiple of its expected one."""
RESTS = 0.2
"""Slower than this share of its usual pace the body is at rest."""


class Healthy:
    """Running statistics of standardised errors, by judged column."""

    def __init__(self, size: int, signals: int = 1) -> None:
        self.count, self.moved = 0, 0.0
        self.caution = 0.0
        """An element that gives no sign of its own is hidden from this sum of squared shares of an alarm on."""
        self._square = np.ones(size)
        self._near, self._far = np.full(size, 0.85), np.full(size, 0.5)
        self._excess, self._exceeding = np.full(size, TAIL * EXCESSES), np.full(size, EXCESSES)
        self._pace = LEAST_PACE
        self._late = np.array([LATE**2, 1.0]) * SEEN
        """Weighted sums of the squares of the errors' parts by timing, and of the squares that `TIMING` would cause."""
        self._lags, self._agreement = np.zeros((signals, signals)), np.zeros(signals)
        """Weighted sums of the products of two signals' changes of the errors, and of these changes with the errors."""
        self._noise, self._noise_count = np.full((2, size), 1e-6), np.zeros((2, size))
        """This is the noise at rest and in motion: values of a fast motion do not fit each other as well."""

    def add(
        self,
        z: np.ndarray,
        steps: np.ndarray,
        noise: np.ndarray,
        motion: float,
        late: np.ndarray | None = None,
        lag: np.ndarray | None = None,
    ) -> None:
        """Learn from one block; columns whose newest error is NaN keep what they have.

        Args:
            z: The newest errors, oldest first, shape (LONGEST, n), in units of the learned ones; NaN where missing.
            steps: Result of the step test, shape (n,).
            noise: Variance of the noise within the block, in the same units, shape (n,); NaN where unknown.
            motion: Result of `motion`; a body at rest shows the same errors again and again.
            late: Changes of the newest errors if one signal is measured `TIMING` later, in the unit of `z`, shape
                (signals, n); not known by default.
            lag: The multiple of these that was taken off the errors, shape (signals,).
        """
        self.count += 1
        self.moved += motion
        self.caution *= 1.0 - 1.0 / FORGETS
        doubted = np.where((steps > COMMON) & (self.count > PRIOR), DOUBTED, 1.0)
        share = doubted * motion / min(PRIOR + self.moved, MEMORY)
        now = z[-1]
        is_new = np.isfinite(now)
        if late is not None and lag is not None:
            self._learn_lateness(now, late, lag)
        square = np.clip(np.where(is_new, now**2, self._square), 0.0, CLEAR * self._square)
        self._square += share * (square - self._square)
        for apart, name in ((1, "_near"), (APART, "_far")):
            mean, product = getattr(self, name), now * z[-1 - apart] / self._square
            product = np.where(np.isfinite(product), np.clip(product, -4.0, 4.0), mean)
            setattr(self, name, mean + share * (product - mean))
        is_noise = np.isfinite(noise)
        weight = is_noise * np.array([[1.0 - motion], [motion]])
        self._noise_count += weight
        share = weight / np.clip(self._noise_count, 1.0, MEMORY)
        change = np.clip(np.where(is_noise, noise, self._noise), 0.0, 9.0 * self._noise + 1e-4)
        self._noise += share * (change - self._noise)

    def add_steps(self, steps: np.ndarray) -> None:
        """Learn how large steps usually are from one block.

        Args:
            steps: Result of the step test, shape (n,); NaN where the newest error is missing.
        """
        above, fade = steps > COMMON, 1.0 - 1.0 / TAIL_MEMORY
        self._excess = self._excess * fade + np.where(above, steps - COMMON, 0.0)
        self._exceeding = self._exceeding * fade + above

    def _learn_lateness(self, now: np.ndarray, late: np.ndarray, lag: np.ndarray) -> None:
        """Learn how late each signal usually is, and how far values are apart in time beyond it; see `add`.

        Args:
            now: The newest errors, shape (n,); NaN where missing.
            late: Changes of these if one signal is measured `TIMING` later, shape (signals, n).
            lag: The multiple of the changes that was taken off the errors, shape (signals,).
        """
        square, timing = self.scale**2, (late**2).sum(axis=0)
        whole, known = square + (late * (self.apart @ late)).sum(axis=0), np.isfinite(now * timing)
        error = np.where(known, np.clip(now, -np.sqrt(CLEAR * whole), np.sqrt(CLEAR * whole)), 0.0)
        weight, beyond = np.where(known, timing / whole**2, 0.0), error**2 - whole + self.lateness**2 * timing
        sums = np.array([(weight * np.nan_to_num(beyond)).sum(), (weight * np.nan_to_num(timing)).sum()])
        sums /= max(1.0, sums[1])  # a block counts once, not once for each of its columns
        self._late += sums - self._late * sums[1] / MEMORY
        late = np.where(known, late, 0.0) / np.where(known, np.sqrt(whole), 1.0)
        error = error / np.where(known, np.sqrt(whole), 1.0)
        products = late @ late.T
        share = 1.0 / max(1.0, np.trace(products))
        fade = 1.0 - share * np.trace(products) / MEMORY
        self._lags = fade * self._lags + share * products
        self._agreement = fade * self._agreement + share * (late @ error + products @ lag)

    def excuse(self, columns: list[int], steps: np.ndarray, was_hidden: bool) -> None:
        """Learn that an alarm was none, because it ended by itself.

        Args:
            columns: The columns that were suspected.
            steps: Their largest steps, shape (n,).
            was_hidden: Whether they were hidden.
        """
        self._excess[columns] += np.maximum(steps[columns] - COMMON, 0.0)
        self._exceeding[columns] += 1.0
        if was_hidden:
            self.caution = min(CAREFUL * max(self.caution, 1.0), MOST_CAREFUL)

    def motion(self, moved: float) -> float:
        """Return how much of a look at a new posture a block is, from 0 at rest to 1.

        Args:
            moved: Root mean square change of all elements since the block before [standard deviations].
        """
        if moved > RESTS * self._pace:
            self._pace = max(LEAST_PACE, self._pace + (moved - self._pace) / min(1.0 + self.count, MEMORY))
        return self.looks(moved)

    def looks(self, distance: float) -> float:
        """Return how many looks at a new posture a distance [standard deviations] is worth, at most 1."""
        return min(1.0, distance / self._pace)

    @property
    def scale(self) -> np.ndarray:
        """Standard deviation of the errors on this body, in units of the learned ones, shape (n,)."""
        return np.clip(np.sqrt(self._square), *SCALES)

    @property
    def lag(self) -> np.ndarray:
        """Multiple of `-TIMING` by which each signal is usually late beside the others, shape (signals,)."""
        return np.clip(self._doubt @ self._agreement, -LATENESS[1], LATENESS[1])

    @property
    def apart(self) -> np.ndarray:
        """Covariance of the times of the signals beyond their lag [squares of `TIMING`], shape (signals, signals)."""
        return np.diag(self.lateness**2 + (VARIES * self.lag) ** 2) + LATE**2 * SEEN * self._doubt

    @property
    def _doubt(self) -> np.ndarray:
        """Inverse of how well the lags are known, shape (signals, signals)."""
        return np.linalg.inv(self._lags + SEEN * np.eye(len(self._lags)))

    @property
    def lateness(self) -> float:
        """Standard deviation of the time between values beyond their usual lag, as a multiple of `TIMING`."""
        return float(np.clip(np.sqrt(max(self._late[0], 0.0) / self._late[1]), *LATENESS))

    @property
    def noise(self) -> np.ndarray:
        """Variance of the noise within a block, in units of the learned errors, shape (n,); infinite if unknown.

        It is the larger one of that at rest and in motion, and unknown while that of a motion is not known yet.
        """
        known = np.where(self._noise_count >= NOISE_KNOWN, self._noise, np.inf)
        has_moved = self._noise_count[1] >= 1.0
        at_rest = np.where(np.isfinite(known[0]), known[0], 0.0)
        return np.where(has_moved, np.maximum(known[1], at_rest), known[0])

    @property
    def likeness(self) -> Likeness:
        """Likeness of neighbouring errors."""
        return Likeness.of(self._near, self._far, APART)

    @property
    def tail(self) -> np.ndarray:
        """Mean excess of large steps, shape (n,)."""
        return np.clip(self._excess / self._exceeding, *TAILS)

    def limit(self, chance: float) -> np.ndarray:
        """Return the step that a healthy element exceeds in one block with this probability, shape (n,)."""
        return np.asarray(COMMON + self.tail * math.log(EXCEEDS * TOGETHER / chance))

    @property
    def is_known(self) -> bool:
        """Whether enough blocks were seen to judge."""
        return self.count >= LONGEST
