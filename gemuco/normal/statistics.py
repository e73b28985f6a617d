"""Statistics of the prediction errors of a healthy body: mean, covariance, threshold and windows (paper, II-K).

The errors are those of the network and, with a `Watch`, of the closed-form prediction of every element from all others.
The Mahalanobis distance of a sample and, where that finds more, its distance from the nearest known samples make one
deviation, in standard deviations of the logarithms that a healthy body has.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from gemuco.compiled import score
from gemuco.compiled.score import BASE
from gemuco.errors import NotEnoughData
from gemuco.normal.watch import Watch
from gemuco.normal.windows import Windows, at_most, correlation_time

SHRINK = 0.7
"""This share of the covariance is usually replaced by its diagonal: errors of several predictions of one element are
alike, and directions in which a few minutes of motion happened to vary little are not those in which a body breaks."""

FLOOR = 0.002
"""The standard deviation of an error is at least this share of the signal's own standard deviation."""

PATTERNS = 64
"""At most this many inverse covariances are cached, one per set of judged elements."""

FOLDS = 5
"""Every sample that sets the threshold is judged by mean and covariance of the other ones of this number of blocks."""

LEAST = 30
"""Normal errors are learned from at least this number of samples, and at least one per error."""

KEPT = 500
"""At most this number of normal samples is kept, to judge samples in which elements are missing."""


WATCHED = ("inputs", "signal", "low", "high", "moments", "penalties")
WINDOWED = ("sizes", "limits", "stds", "variance", "shift", "shift_stds", "scatter")
"""Arrays of a watch, and of windows, in the order of their arguments; older models lack the last one."""


class Scale(NamedTuple):
    """Logarithms of the distances of normal samples, and the part of the neighbours in a deviation.

    Attributes:
        mean: Mean logarithm of the Mahalanobis distance.
        std: Its standard deviation.
        near_mean: Mean logarithm of the distance from the nearest samples, as a share of their own.
        near_std: Its standard deviation.
        weight: Weight of this distance; 0: not used.
    """

    mean: float
    std: float
    near_mean: float = 0.0
    near_std: float = 1.0
    weight: float = 0.0

    @classmethod
    def of(cls, distances: np.ndarray, near: np.ndarray, weight: float) -> "Scale":
        """Measure distances and neighbour distances of normal samples, each of shape (n,)."""
        logs = np.log(np.maximum(distances, 1e-9))
        if not weight:
            return cls(float(logs.mean()), max(float(logs.std()), 1e-3))
        close = np.log(np.maximum(near, 1e-9))
        return cls(float(logs.mean()), max(float(logs.std()), 1e-3), float(close.mean()), float(close.std()), weight)

    def deviations(self, distances: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return the deviations [standard deviations] of samples from their two distances, each of shape (n,)."""
        z = (np.log(np.maximum(distances, 1e-9)) - self.mean) / self.std
        if not self.weight:
            return z
        away = (np.log(np.maximum(near, 1e-9)) - self.near_mean) / self.near_std
        return np.sqrt(np.maximum(z + BASE, 0.0) ** 2 + self.weight * np.maximum(away + BASE, 0.0) ** 2) - BASE

    def distance(self, deviation: np.ndarray | float) -> np.ndarray:
        """Return the Mahalanobis distance that alone would be this deviation."""
        return np.asarray(np.exp(self.mean + self.std * np.asarray(deviation, float)))


def _nothing() -> np.ndarray:
    return np.zeros((0, 0))


@dataclass(frozen=True, slots=True)
class Normal:
    """Statistics of the prediction errors of a healthy body.

    Attributes:
        mean: Mean error, shape (errors,): of x_out [unit], then residuals of the watch [standard deviations]; NaN where
            no errors are known.
        covariance: Regularised covariance, shape (errors, errors).
        threshold: A healthy body's score is above this with the probability `false_alarm`.
        false_alarm: Promised probability of a false alarm per sample.
        watch: Closed-form prediction of every element; None in older models.
        rows: Some of the normal samples [standard deviations] with their p, shape (n, size + bias_size).
        cloud: Known samples [standard deviations], shape (n, size); empty if their distance is not used.
        scale: Logarithms of the distances of normal samples; None in older models.
        windows: Limits of windows of samples; None in older models.
        samples: Number of samples that set the threshold.
        bound: The rate of false alarms is at most this with 95 % confidence, from normal samples that were not learned
            from; 1 if unknown.
        shrink: Share of the covariance that was replaced by its diagonal.
        usual: Number of errors that are judged when no element is missing.
    """

    mean: np.ndarray
    covariance: np.ndarray
    threshold: float
    false_alarm: float
    watch: Watch | None = None
    rows: np.ndarray = field(default_factory=_nothing, repr=False)
    cloud: np.ndarray = field(default_factory=_nothing, repr=False)
    scale: Scale | None = None
    windows: Windows | None = None
    samples: int = 0
    bound: float = 1.0
    shrink: float = SHRINK
    usual: int = field(init=False, repr=False)
    known: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Values that other rooms compute from these statistics alone, so that they outlast a change of W or p."""
    _precisions: dict[bytes, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "usual", int(np.isfinite(self.mean).sum()))

    @classmethod
    def fit(
        cls,
        errors: np.ndarray,
        spread: np.ndarray,
        false_alarm: float = 1e-3,
        near: np.ndarray | None = None,
        weight: float = 0.0,
        shrink: float = SHRINK,
        samples: np.ndarray | None = None,
    ) -> "Normal":
        """Compute the statistics of a healthy body.

        Args:
            errors: Prediction errors, oldest first, shape (samples, errors), NaN where unknown.
            spread: Standard deviation of every predicted element [unit of its error], shape (errors,).
            false_alarm: Share of healthy samples that may lie above the threshold.
            near: Distance of every sample from the nearest known samples, shape (samples,).
            weight: Weight of this distance.
            shrink: Share of the covariance that is replaced by its diagonal.
            samples: The samples themselves [standard deviations], shape (samples, size).

        Raises:
            NotEnoughData: Fewer complete samples than errors, or than `LEAST`.
        """
        seen = np.isfinite(errors).mean(axis=0) > 0.5
        whole = np.isfinite(errors[:, seen]).all(axis=1)
        rows = errors[whole][:, seen]
        needed = max(LEAST, int(seen.sum()))
        if not seen.any() or len(rows) < needed:
            raise NotEnoughData(
                f"Normal statistics of {int(seen.sum())} errors need {needed} complete samples; there are {len(rows)}."
            )
        near = np.ones(len(rows)) if near is None else near[whole]
        distances = np.empty(len(rows))
        for part in np.array_split(np.arange(len(rows)), FOLDS):
            others = np.delete(rows, part, axis=0)
            distances[part] = _distances(rows[part] - others.mean(axis=0), covariance_of(others, spread[seen], shrink))
        scale = Scale.of(distances, near, weight)
        deviations = scale.deviations(distances, near)
        mean, covariance = np.full(len(seen), np.nan), np.diag(np.asarray(spread, float) ** 2)
        mean[seen], part_of = rows.mean(axis=0), covariance_of(rows, spread[seen], shrink)
        covariance[np.ix_(seen, seen)] = part_of
        away = (rows - mean[seen]) / np.sqrt(np.diag(part_of))
        windows = Windows.fit(deviations, away, false_alarm, None if samples is None else samples[whole])
        above = float((deviations > windows.limits[0]).mean())
        return cls(
            mean,
            covariance,
            float(scale.distance(windows.limits[0])),
            false_alarm,
            scale=scale,
            windows=windows,
            samples=len(rows),
            shrink=shrink,
            bound=at_most(above, len(rows) / correlation_time(deviations)),
        )

    @property
    def trust(self) -> str:
        """The promised rate of false alarms, and what is known of it, in words."""
        if not self.samples:
            return f"{self.false_alarm:.1%} false alarms promised"
        return (
            f"{self.false_alarm:.1%} false alarms promised, at most {self.bound:.1%} with 95 % confidence "
            f"({self.samples} normal samples)"
        )

    def facts(self) -> dict[str, Any]:
        """Return everything but the arrays, as JSON values."""
        return {
            "threshold": self.threshold,
            "false_alarm": self.false_alarm,
            "scale": None if self.scale is None else list(self.scale),
            "samples": self.samples,
            "bound": self.bound,
            "shrink": self.shrink,
            "count": None if self.watch is None else self.watch.count,
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays by name."""
        arrays = {"mean": self.mean, "covariance": self.covariance, "rows": self.rows, "cloud": self.cloud}
        if self.watch is not None:
            arrays |= {f"watch.{name}": getattr(self.watch, name) for name in WATCHED}
        if self.windows is not None:
            windowed = {f"windows.{name}": getattr(self.windows, name) for name in WINDOWED}
            arrays |= {name: array for name, array in windowed.items() if array is not None}
        return arrays

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> "Normal":
        """Return the statistics of these arrays and facts; older ones lack the watch and the windows."""
        scale, watch, windows = facts.get("scale"), None, None
        if facts.get("count") is not None:
            inputs, signal, low, high, moments, penalties = (arrays[f"watch.{name}"] for name in WATCHED)
            watch = Watch(inputs, signal, low, high, moments, penalties, facts["count"])
        if scale is not None:
            sizes, limits, stds, variance, shift, shift_stds = (arrays[f"windows.{name}"] for name in WINDOWED[:-1])
            windows = Windows(sizes, limits, stds, variance, shift, shift_stds, arrays.get("windows.scatter"))
        return cls(
            arrays["mean"],
            arrays["covariance"],
            facts["threshold"],
            facts["false_alarm"],
            watch,
            arrays.get("rows", _nothing()),
            arrays.get("cloud", _nothing()),
            None if scale is None else Scale(*scale),
            windows,
            facts.get("samples", 0),
            facts.get("bound", 1.0),
            facts.get("shrink", SHRINK),
        )

    def shapes(self, size: int, outputs: int, bias: int) -> list[tuple[str, np.ndarray, tuple[int, ...]]]:
        """List (name, array, right shape) for a body with these sizes of layout, x_out and p."""
        inputs, features, targets, residuals = 0, 0, 0, 0
        if self.watch is not None:
            inputs = len(self.watch.inputs)
            features, targets, residuals = self.watch.sizes
        errors, levels = outputs + residuals, 0 if self.windows is None else len(self.windows.sizes)
        right: dict[str, tuple[int, ...]] = {
            "mean": (errors,),
            "covariance": (errors, errors),
            "rows": (len(self.rows), size + bias if len(self.rows) else 0),
            "cloud": (len(self.cloud), size if len(self.cloud) else 0),
            "watch.inputs": (inputs,),
            "watch.signal": (inputs,),
            "watch.low": (inputs,),
            "watch.high": (inputs,),
            "watch.moments": (features, features),
            "watch.penalties": (targets,),
            "windows.sizes": (levels,),
            "windows.limits": (levels,),
            "windows.variance": (levels, self.usual),
            "windows.stds": (levels,),
            "windows.shift": (levels,),
            "windows.shift_stds": (levels,),
            "windows.scatter": (levels, size),
        }
        return [(f"normal.{name}", array, right[name]) for name, array in self.arrays().items()]

    def distance(self, error: np.ndarray) -> tuple[float, np.ndarray, int]:
        """Return the distance of one error, shape (errors,), judged by its finite elements.

        Returns:
            The Mahalanobis distance, the contribution of each element (the decrease of the squared distance without
            this element: (P e)_i^2 / P_ii), and the number of judged elements.
        """
        index, precision = self.precision(np.isfinite(error - self.mean))
        if not len(index):
            return float("nan"), np.full(len(error), np.nan), 0
        distance, contribution = score.distance(error, self.mean, index, precision)
        return distance, contribution, len(index)

    def distances(self, errors: np.ndarray) -> np.ndarray:
        """Return the distances of errors that lack the same elements, shape (samples, errors) -> (samples,)."""
        index, precision = self.precision(np.isfinite(errors[0] - self.mean))
        e = errors[:, index] - self.mean[index]
        return np.sqrt(np.einsum("ij,jk,ik->i", e, precision, e).clip(min=0.0))

    def threshold_of(self, judged: int | np.ndarray) -> np.ndarray:
        """Return the threshold for a number of judged elements; its square is proportional to this number.

        Args:
            judged: Number of judged elements, a scalar or of shape (samples,).

        Returns:
            The threshold; NaN where no element is judged.
        """
        share = np.asarray(judged, float) / self.usual
        return np.where(share > 0.0, self.threshold * np.sqrt(share), np.nan)

    def precision(self, judged: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of the judged elements, shape (n,), and the inverse of their covariance, shape (n, n).

        Args:
            judged: Truth values, shape (errors,); an element needs a known error and a known mean.
        """
        precision = self._precisions.get(judged.tobytes())
        if precision is None:
            index = np.flatnonzero(judged)
            precision = index, np.linalg.inv(self.covariance[np.ix_(index, index)])
            if len(self._precisions) >= PATTERNS:
                self._precisions.clear()
            self._precisions[judged.tobytes()] = precision
        return precision


def covariance_of(errors: np.ndarray, spread: np.ndarray, shrink: float) -> np.ndarray:
    """Return the regularised covariance of normal errors, shape (samples, n) -> (n, n); `spread` as in `fit`."""
    part = np.cov(errors.T).reshape(errors.shape[1], -1)
    return np.asarray((1.0 - shrink) * part + np.diag(shrink * np.diag(part) + (FLOOR * spread) ** 2))


def _distances(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ij,ij->i", errors, np.linalg.solve(covariance, errors.T).T).clip(min=0.0))
