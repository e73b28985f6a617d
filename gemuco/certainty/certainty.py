"""The facts of training from which the std of an estimate follows.

An estimate of an element is made in one of several ways: a method, and the signals that it is given. The std of a
sample is the expected error of the way, times a factor that grows with the distance from the nearest anchors, with the
leverage (the relative variance of a regression with linear and squared features), with the residual of the given
values, and towards the edges of their ranges. Beyond the distances of held-out samples the nonlinear part of the body
may change as it does between anchors that are as far from each other: this variance is added.

The factor is calibrated (split conformal, per way and element): 90 % of the errors of held-out samples are within
`NINETY` std.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from gemuco.masks import Mask

NINETY = 1.6449
"""An interval of this many std to both sides contains the truth in 90 of 100 held-out samples."""
KNOTS = 12
"""The growth of the error with the distance is known at this many distances."""
RIDGE = 1e-3
"""The regularisation of the leverage, as a share of the mean square of a feature."""

MOST = 1e3
"""No limit, and no slope of a logarithm, is as large as this."""

Way = tuple[str, Mask]
"""A way to estimate is a method and the signals that it is given."""
ARRAYS = ("low", "high", "moments", "logs", "limits", "slopes", "knots", "growth")


class Reach(NamedTuple):
    """The learned part of the inputs of one way to estimate, for compiled code; see `gemuco.compiled.certainty`.

    Attributes:
        anchors: Elements of the anchors [standard deviations], shape (n, anchors), float32.
        precision: Inverse second moments of the features, shape (f, f).
        elements: Positions of the elements in the layout, shape (n,).
    """

    anchors: np.ndarray
    precision: np.ndarray
    elements: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Certainty:
    """The calibration of all ways to estimate.

    Attributes:
        ways: The ways that were calibrated.
        low: Lowest value of every element in the training data [standard deviations], shape (size,).
        high: Highest value, shape (size,).
        moments: Mean products of the features 1, elements, and their squares, shape (1 + 2 size,) * 2.
        logs: Per way: mean, standard deviation, smallest and largest standardised value of the four measures of
            `gemuco.compiled.certainty.novelty`, shape (ways, 4, 4).
        limits: Per way: length of the first three measures above which a sample is doubtful, and unknown, shape
            (ways, 2).
        slopes: Per way and element: logarithm of the std, as a share of the expected error, by 1 and the four measures,
            shape (ways, size, 5).
        knots: Per way: distances of the growth, shape (ways, `KNOTS`).
        growth: Per way: half the mean squared difference of the nonlinear parts of anchors at these distances [standard
            deviations squared], shape (ways, `KNOTS`, size).
        covariance: Covariance of p if it was recognised, shape (b, b); None if it is unknown.
        unseen: Whether each element was not measured since the body changed, shape (size,); None: none.
        excess: Errors seen with the present p, as a share of those learned.
    """

    ways: tuple[Way, ...]
    low: np.ndarray
    high: np.ndarray
    moments: np.ndarray
    logs: np.ndarray
    limits: np.ndarray
    slopes: np.ndarray
    knots: np.ndarray
    growth: np.ndarray
    covariance: np.ndarray | None = None
    unseen: np.ndarray | None = None
    excess: float = 1.0
    known: dict[Any, Any] = field(default_factory=dict, repr=False)
    """This holds results that depend on no p; the copies of a certainty share it."""

    def place(self, way: Way) -> int | None:
        """Return the index of a way; None if it was not calibrated."""
        return self.ways.index(way) if way in self.ways else None

    def at(self, covariance: np.ndarray | None, unseen: np.ndarray | None, excess: float = 1.0) -> "Certainty":
        """Return the same calibration with other facts of the present p; see the attributes."""
        return replace(self, covariance=covariance, unseen=unseen, excess=excess)

    def reach(self, anchors: np.ndarray, elements: np.ndarray) -> Reach:
        """Return the learned part of some elements.

        Args:
            anchors: The anchors [standard deviations], shape (anchors, size).
            elements: Positions of the elements in the layout, shape (n,).
        """
        key = elements.tobytes()
        reach: Reach | None = self.known.get(key)
        if reach is None:
            reach = self.known[key] = reach_of(anchors, self.moments, elements)
        return reach

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays by name."""
        return {name: getattr(self, name) for name in ARRAYS}

    @classmethod
    def of(cls, ways: tuple[Way, ...], arrays: Mapping[str, np.ndarray]) -> "Certainty":
        """Return the certainty of these ways and arrays."""
        low, high, moments, logs, limits, slopes, knots, growth = (arrays[name] for name in ARRAYS)
        return cls(ways, low, high, moments, logs, limits, slopes, knots, growth)

    def check(self) -> None:
        """Refuse numbers that no calibration gives, with which every estimate would look sure, or none.

        Raises:
            ValueError: A number is impossible.
        """
        possible = {
            "low": self.low <= self.high,
            "logs": (self.logs[..., 1] > 0.0) & (self.logs[..., 2] <= self.logs[..., 3]),
            "limits": (self.limits >= 0.0) & (self.limits < MOST),
            "slopes": np.abs(self.slopes) < MOST,
            "knots": self.knots > 0.0,
            "growth": self.growth >= 0.0,
        }
        for name, is_possible in possible.items():
            if not is_possible.all():
                raise ValueError(f"array certainty.{name} holds a number that no training gives")

    def shapes(self, size: int) -> list[tuple[str, np.ndarray, tuple[int, ...]]]:
        """List (name, array, right shape) for a body with this size of the layout."""
        count, wide = len(self.ways), 1 + 2 * size
        right = {
            "low": (size,),
            "high": (size,),
            "moments": (wide, wide),
            "logs": (count, 4, 4),
            "limits": (count, 2),
            "slopes": (count, size, 5),
            "knots": (count, KNOTS),
            "growth": (count, KNOTS, size),
        }
        return [(f"certainty.{name}", array, right[name]) for name, array in self.arrays().items()]


def features(x: np.ndarray) -> np.ndarray:
    """Return the features 1, x, and the squares of x, shape (samples, 1 + 2 n).

    Args:
        x: Elements [standard deviations], shape (samples, n).
    """
    return np.concatenate([np.ones((len(x), 1)), x, x**2], axis=1)


def reach_of(anchors: np.ndarray, moments: np.ndarray, elements: np.ndarray) -> Reach:
    """Return the learned part of some elements; see `Certainty.reach`.

    Args:
        anchors: The anchors [standard deviations], shape (anchors, size).
        moments: See `Certainty`.
        elements: Positions of the elements in the layout, shape (n,).
    """
    kept = np.concatenate([[0], 1 + elements, 1 + anchors.shape[1] + elements]).astype(int)
    part = moments[np.ix_(kept, kept)]
    part = part + RIDGE * np.diag(part).mean() * np.eye(len(part))
    return Reach(np.ascontiguousarray(anchors[:, elements].T, np.float32), np.linalg.inv(part), elements)
