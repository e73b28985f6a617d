"""Estimates of elements from all measured ones, those of their own signal included, in closed form.

A mask knows whole signals. If one of four wheel speeds is lost, the other three say more of it than all other signals
do. The second moments of the watch give a ridge regression for any set of measured elements; its expected error is that
on normal samples, and grows with the distance from them.
"""

from dataclasses import dataclass, replace

import numpy as np

from gemuco.certainty.certainty import NINETY
from gemuco.intervals.sureness import Judgement, RangeJudge, about_p, worse
from gemuco.masks import Mask
from gemuco.normal.statistics import Normal
from gemuco.normal.watch import Reading, error_growth, without_features
from gemuco.schema import BodySchema

METHOD = "regression"
"""The name of this way to estimate."""
LEAST, MOST = 30, 150
"""The expected error is that on at least and at most this number of normal samples."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Ridge regression of missing elements on the measured ones.

    Attributes:
        elements: Positions of the missing elements, ascending, shape (k,).
        reading: Features of a sample.
        maps: Elements [standard deviations] by features, shape (features, k).
        spread: Inverse of the moments of the features, shape (features, features).
        distance: Mean distance of the normal samples, by this inverse.
        std: Expected error at this distance [standard deviations], shape (k,); see `gemuco.certainty.Certainty`.
    """

    elements: np.ndarray
    reading: Reading
    maps: np.ndarray
    spread: np.ndarray
    distance: float
    std: np.ndarray

    @classmethod
    def of(cls, schema: BodySchema, finite: np.ndarray) -> "Fit | None":
        """Return the regression of all missing elements that a body's watch predicts; None if there are none.

        Args:
            schema: The body schema.
            finite: Whether each element of the layout is measured, shape (size,).
        """
        normal = schema.normal
        if normal is None or normal.watch is None or len(normal.rows) < LEAST:
            return None
        watch, measured = normal.watch, np.concatenate([finite, np.ones(len(schema.bias), bool)])
        singles = watch.inputs[watch.signal >= 0]
        elements = singles[~finite[singles]]
        if not len(elements):
            return None
        places, kept = np.searchsorted(watch.inputs, elements), watch.kept(measured[watch.inputs])
        penalties = watch.penalties[np.searchsorted(singles, elements)]
        maps, spread = np.zeros((int(kept.sum()), len(elements))), np.zeros((0, 0))
        for penalty in np.unique(penalties):
            own = penalties == penalty
            spread = without_features(watch.inverse(float(penalty)), ~kept)[np.ix_(kept, kept)]
            maps[:, own] = spread @ watch.moments[np.ix_(kept, 1 + places[own])]
        reading, distance, std = watch.reading(measured, maps=False), 1.0, np.ones(len(elements))
        return cls(elements, reading, maps, spread, distance, std)._judged(normal)

    def _judged(self, normal: Normal) -> "Fit":
        """Return the same with the errors on normal samples."""
        rows = normal.rows[np.linspace(0, len(normal.rows) - 1, min(MOST, len(normal.rows))).astype(int)].astype(float)
        features = self.reading.features(rows)
        far = self._far(features)
        distance = max(float(far.mean()), 1e-9)
        errors = np.abs(rows[:, self.elements] - features @ self.maps) / error_growth(far, distance)[:, None]
        std = np.maximum(np.sqrt(np.mean(errors**2, axis=0)), np.quantile(errors, 0.9, axis=0) / NINETY)
        return replace(self, distance=distance, std=std * _optimism(normal, self.elements, rows))

    def growth(self, features: np.ndarray) -> np.ndarray:
        """Return how much larger the errors are at samples, shape (n, features) -> (n,)."""
        return error_growth(self._far(features), self.distance)

    def _far(self, features: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("ij,ij->i", features @ self.spread, features))


def _optimism(normal: Normal, elements: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return how much larger errors are than those on the normal samples, which may have been learned from: (k,).

    Args:
        normal: What is normal for the body.
        elements: Positions of the elements, ascending, shape (k,).
        rows: Normal samples with their p [standard deviations], shape (n, size + bias_size).
    """
    assert normal.watch is not None
    whole = normal.watch.reading(None)
    known, first = np.unique(whole.target, return_index=True)  # elements alone come before those of whole signals
    single = first[np.searchsorted(known, elements)]
    within = np.sqrt(np.mean(whole.residuals(rows)[:, single] ** 2, axis=0))
    promised = np.sqrt(np.diag(normal.covariance))[-len(whole.target) :][single]
    ratio = promised / np.maximum(within, 1e-9)
    return np.asarray(np.where(np.isfinite(ratio), np.maximum(1.0, ratio), 1.0))


class Regression:
    """Estimates of missing elements, with their std and state, for samples with the same elements.

    Attributes:
        std: Expected error of every element [unit], shape (size,); NaN for those that are not estimated.
        given: Signals of which some elements are measured.
    """

    def __init__(self, schema: BodySchema, fit: Fit, finite: np.ndarray) -> None:
        """Prepare for a fit on these measured elements, shape (size,)."""
        self.given: Mask = frozenset(name for name, span in schema.layout.slices.items() if finite[span].any())
        self._schema, self._fit = schema, fit
        self._range, self._about_p = RangeJudge(schema, self.given, finite), about_p(schema)
        excess = 1.0 if schema.certainty is None else max(1.0, schema.certainty.excess)
        self.std = np.full(schema.layout.size, np.nan)
        self.std[fit.elements] = fit.std * excess * schema.scaler.std[fit.elements]

    @classmethod
    def of(cls, schema: BodySchema, finite: np.ndarray) -> "Regression | None":
        """Return the estimates of the missing elements, shape (size,); None if they are not possible."""
        fit = Fit.of(schema, finite)
        return None if fit is None else cls(schema, fit, finite)

    def predict(self, joined: np.ndarray, requested: np.ndarray, value: np.ndarray) -> None:
        """Write estimates into a completed sample [unit], shape (size,).

        Args:
            joined: Every element of the layout [unit], shape (size,), NaN where missing.
            requested: Whether each element is requested, truth values, shape (size,).
            value: Result, shape (size,).
        """
        elements, scaler = self._fit.elements, self._schema.scaler
        own = requested[elements]
        values = (self._features(joined) @ self._fit.maps[:, own])[0]
        value[elements[own]] = values * scaler.std[elements[own]] + scaler.mean[elements[own]]

    def judge(self, joined: np.ndarray, residual: float, requested: np.ndarray, std: np.ndarray) -> Judgement:
        """Write the std of the requested elements, and return their judgement; see `Judge.judge`."""
        std[requested] = self._fit.growth(self._features(joined))[0] * self.std[requested]
        judgement = self._range.judge(joined, residual, requested, std)
        return Judgement(worse(judgement.sureness, self._about_p), judgement.inside)

    def _features(self, joined: np.ndarray) -> np.ndarray:
        schema = self._schema
        return self._fit.reading.features(np.concatenate([schema.scaler.normalise(joined), schema.bias])[None])
