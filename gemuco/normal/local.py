"""Size of a healthy error at each sample: a steering angle is not known from the motion of a car that stands.

Errors have steps: where another value is above a limit, they are larger or smaller by a factor. Neither the value
itself nor a hidden one decides, so that no lie excuses itself. A column keeps one size where steps do not describe
held-out errors better.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

BLOCKS = 5
"""Each of this many blocks of the samples is judged by the others."""
BETTER = 0.05
"""The mean log likelihood of held-out errors must rise by this much per error."""
LEAST = 4
"""At least this many known errors per used column are needed."""
STEPS = 4
"""A column has at most this number of steps."""
LIMITS, LEAF = 32, 10
"""Limits of steps are in the middle between successive quantiles of a value, this number of them; at least the second
number of errors is on either side."""
SURE = 3.0
"""Errors on one side of a step that are few, or all alike, may be larger next time: a factor makes this number of
standard deviations as unlikely as those of Student's t."""
SMALLEST = 1e-3
"""Squared errors on one side of a step are at least this share of the usual ones."""
SMALLER = 0.5
"""That errors are smaller than usual is believed less: the logarithm of the factor is multiplied by this."""
RANGE = 0.2, 30.0
"""Errors are at least and at most this many times the usual ones."""


class Grid(NamedTuple):
    """The known samples, and the limits at which steps may be.

    Attributes:
        values: The samples [standard deviations], in order of time, shape (n, columns).
        limits: The limits, ascending, shape (LIMITS, columns).
        bins: Number of limits that each value has reached, shape (n, columns).
    """

    values: np.ndarray
    limits: np.ndarray
    bins: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> "Grid":
        """Return the grid of known samples [standard deviations], in order of time, shape (n, columns)."""
        knots = np.quantile(values, np.linspace(0.0, 1.0, LIMITS + 1), axis=0)
        limits = 0.5 * (knots[:-1] + knots[1:])
        return cls(values, limits, (values[:, :, None] >= limits.T).sum(axis=2))


@dataclass(frozen=True, slots=True, eq=False)
class LocalSize:
    """Healthy errors as a function of the sample.

    Attributes:
        place: The value that decides each step of each column, shape (columns, STEPS).
        limit: Its limit [standard deviations], shape (columns, STEPS).
        below: Logarithm of the factor below the limit, shape (columns, STEPS); 0 without a step.
        above: The same from the limit on.
    """

    place: np.ndarray
    limit: np.ndarray
    below: np.ndarray
    above: np.ndarray

    @classmethod
    def even(cls, columns: int) -> "LocalSize":
        """Return one size for each of some columns."""
        shape = columns, STEPS
        return cls(np.zeros(shape, int), np.zeros(shape), np.zeros(shape), np.zeros(shape))

    @classmethod
    def fit(
        cls, grid: Grid, ratios: np.ndarray, hidden: frozenset[int], like: "LocalSize | None" = None
    ) -> "LocalSize":
        """Learn the sizes of healthy errors.

        Args:
            grid: The known samples.
            ratios: Their errors [usual errors], shape (n, columns), NaN where not known.
            hidden: Columns that are not used.
            like: Sizes without hidden columns; their steps are used where they need no hidden one.
        """
        columns = ratios.shape[1]
        size, steps = cls.even(columns), np.full(columns, STEPS) if like is None else like.steps
        for column in np.flatnonzero(steps).tolist():
            known = np.isfinite(ratios[:, column])
            used = np.array([c for c in range(columns) if c != column and c not in hidden], int)
            ratio = ratios[known, column]
            if known.sum() < LEAST * len(used) or not len(used) or not ratio.any():
                continue
            ratio = ratio / np.sqrt(np.mean(ratio**2))
            for number in range(steps[column]):
                if like is not None and like.place[column, number] in used:
                    place, limit = like.place[column, number], like.limit[column, number]
                elif (step := _step(grid.bins[np.ix_(known, used)], ratio)) is not None:
                    place, limit = used[step[0]], grid.limits[step[1], used[step[0]]]
                else:
                    break
                is_below = grid.values[known, place] < limit
                if is_below.all() or not is_below.any():
                    break
                factors = _factor(ratio, is_below), _factor(ratio, ~is_below)
                size.place[column, number], size.limit[column, number] = place, limit
                size.below[column, number], size.above[column, number] = factors
                ratio = ratio / np.exp(np.where(is_below, *factors))
        return size

    @property
    def steps(self) -> np.ndarray:
        """Number of steps of each column, shape (columns,)."""
        return np.asarray(((self.below != 0.0) | (self.above != 0.0)).sum(axis=1))

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the size of a healthy error at samples [usual errors], shape (n, columns) -> (n, columns)."""
        is_below = np.nan_to_num(values)[:, self.place] < self.limit
        factor = np.where(is_below, self.below, self.above).sum(axis=2)
        return np.asarray(np.clip(np.exp(np.where(factor < 0.0, SMALLER * factor, factor)), *RANGE))


def _step(bins: np.ndarray, ratio: np.ndarray) -> tuple[int, int] | None:
    """Return column and limit of the step that describes errors best; None if held-out ones are better without.

    Args:
        bins: Number of limits that each value has reached, shape (n, columns).
        ratio: Errors [usual errors], shape (n,).
    """
    count, columns = bins.shape
    part = np.arange(count) * BLOCKS // count
    code = ((part[:, None] * columns + np.arange(columns)) * (LIMITS + 1) + bins).ravel()
    shape, size = (BLOCKS, columns, LIMITS + 1), BLOCKS * columns * (LIMITS + 1)
    numbers = np.bincount(code, minlength=size).reshape(shape).cumsum(axis=2)
    squares = np.bincount(code, np.repeat(ratio**2, columns), size).reshape(shape).cumsum(axis=2)
    gain = 0.0
    for block in range(BLOCKS):
        others = numbers.sum(axis=0) - numbers[block], squares.sum(axis=0) - squares[block]
        step = _best_step(*others)
        if step is None:
            return None
        column, at, *factors = step
        held, usual = part == block, np.sqrt(max(others[1][0, -1] / others[0][0, -1], 1e-12))
        size_of = np.exp(np.where(bins[held, column] <= at, *factors))
        gain += _likelihood(ratio[held], size_of) - _likelihood(ratio[held], usual)
    step = _best_step(numbers.sum(axis=0), squares.sum(axis=0))
    return None if gain <= BETTER * count or step is None else step[:2]


def _likelihood(errors: np.ndarray, size: np.ndarray) -> float:
    """Return the logarithm of the likelihood of errors, but for a constant, if they have these sizes, shapes (n,)."""
    return -float(np.sum(np.log(size) + 0.5 * (errors / size) ** 2))


def _factor(ratio: np.ndarray, member: np.ndarray) -> float:
    """Return the logarithm of the size of some errors, larger if they are few; both in order of time, shape (n,).

    Errors that hardly change from one sample to the next count as one per stretch of time.
    """
    own, both = ratio[member], member[1:] & member[:-1]
    square = max(float(np.mean(own**2)), SMALLEST)
    stretches = int(member[0]) + int((member[1:] & ~member[:-1]).sum())
    alike = float((ratio[1:] * ratio[:-1])[both].mean()) / square if both.any() else 0.0
    alike = min(max(alike, 0.0), 1.0)
    freedom = max(stretches, len(own) * (1.0 - alike) / (1.0 + alike), 2.0) - 1.0
    return 0.5 * float(np.log(square * freedom * np.expm1(SURE**2 / freedom) / SURE**2))


def _side(cumulated: np.ndarray, side: int) -> np.ndarray:
    """Return what is below each limit (0), or from it on (1), of cumulated numbers, shape (columns, LIMITS)."""
    below = cumulated[:, :-1]
    return below if side == 0 else cumulated[:, -1:] - below


def _best_step(numbers: np.ndarray, squares: np.ndarray) -> tuple[int, int, float, float] | None:
    """Return the most likely step; None if no limit has enough errors on both sides.

    Args:
        numbers: Number of errors up to each limit of each column, and of all, shape (columns, LIMITS + 1).
        squares: Their sums of squares.
    """
    sides = [(_side(numbers, side), _side(squares, side)) for side in (0, 1)]
    least = max(SMALLEST * squares[0, -1] / numbers[0, -1], 1e-12)
    means = [np.maximum(square / np.maximum(number, 1), least) for number, square in sides]
    likelihood = -sum(number * np.log(mean) for (number, _), mean in zip(sides, means, strict=True))
    enough = np.minimum(sides[0][0], sides[1][0]) >= LEAF
    if not enough.any():
        return None
    column, at = np.unravel_index(int(np.argmax(np.where(enough, likelihood, -np.inf))), enough.shape)
    below, above = (0.5 * float(np.log(mean[column, at])) for mean in means)
    return int(column), int(at), below, above
