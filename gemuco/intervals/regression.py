"""Estimates of elements from all measured ones, those of their own signal included, in closed form.

A mask knows whole signals. If one of four wheel speeds is lost, the other three say more of it than all other signals
do. The second moments of the watch give a ridge regression for any set of measured elements; its expected error is that
on normal samples, and grows with the distance from them.
"""

from dataclasses import dataclass

import numpy as np

from gemuco.certainty.certainty import NINETY
from gemuco.intervals.sureness import Judgement, RangeJudge, about_p, worse
from gemuco.masks import Mask
from gemuco.normal.statistics import Normal
from gemuco.normal.watch import Reading
from gemuco.schema import BodySchema

METHOD = "regression"
"""The name of this way to estimate."""
LEAST = 30
"""The expected error is known from at least this number of normal samples."""
NEAR = 0.2
"""The variance of a prediction has this constant part; the rest grows with the distance from the normal samples."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Ridge regression of some elements on the measured ones.

    Attributes:
        elements: Positions of the predicted elements, shape (k,).
        reading: Features of a sample.
        maps: Elements [standard deviations] by features, shape (features, k).
        spread: Inverse of the moments of the features, shape (features, features).
        distance: Mean distance of the normal samples.
        std: Expected error at this distance [standard deviations], shape (k,); see `gemuco.certainty.Certainty`.
    """

    elements: np.ndarray
    reading: Reading
    maps: np.ndarray
    spread: np.ndarray
    distance: float
    std: np.ndarray

    def growth(self, features: np.ndarray) -> np.ndarray:
        """Return how much larger the errors are at samples, shape (n, features) -> (n,)."""
        far = np.einsum("ij,ij->i", features @ self.spread, features)
        return np.asarray(np.sqrt((NEAR * self.distance + far) / ((1.0 + NEAR) * self.distance)))


def fit_of(normal: Normal, finite: np.ndarray, elements: np.ndarray) -> Fit | None:
    """Return the regression of missing elements on the measured ones; None if it is not possible.

    Args:
        normal: What is normal for the body.
        finite: Whether each element, and each element of p, is measured, shape (size + bias_size,).
        elements: Positions of the missing elements, shape (k,).
    """
    watch = normal.watch
    if watch is None or len(normal.rows) < LEAST or not np.isin(elements, watch.inputs[watch.signal >= 0]).all():
        return None
    reading = watch.reading(finite, maps=False)
    places = np.searchsorted(watch.inputs, elements)
    kept, singles = watch.kept(finite[watch.inputs]), np.flatnonzero(watch.signal >= 0)
    maps = np.zeros((int(kept.sum()), len(elements)))
    penalties = watch.penalties[np.searchsorted(singles, places)]
    inverse = np.zeros((0, 0))
    for penalty in np.unique(penalties):
        own = penalties == penalty
        inverse = watch.inverse(float(penalty), kept)
        maps[:, own] = inverse @ watch.moments[np.ix_(kept, 1 + places[own])]
    rows = normal.rows.astype(float)
    features = reading.features(rows)
    far = np.einsum("ij,ij->i", features @ inverse, features)
    draft = Fit(elements, reading, maps, inverse, max(float(far.mean()), 1e-9), np.zeros(len(elements)))
    errors = np.abs(rows[:, elements] - features @ maps) / draft.growth(features)[:, None]
    ninety = np.quantile(errors, 0.9, axis=0) / NINETY
    std = np.maximum(np.sqrt(np.mean(errors**2, axis=0)), ninety) * _optimism(normal, elements, rows)
    return Fit(elements, reading, maps, inverse, draft.distance, std)


def _optimism(normal: Normal, elements: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return how much larger errors are than those on the normal samples, which may have been learned from: (k,)."""
    assert normal.watch is not None
    whole = normal.watch.reading(None)
    single = np.flatnonzero(np.isin(whole.target, elements))
    _, first = np.unique(whole.target[single], return_index=True)
    single = single[first]
    within = np.sqrt(np.mean(whole.residuals(rows)[:, single] ** 2, axis=0))
    residuals = len(whole.target)
    promised = np.sqrt(np.diag(normal.covariance))[-residuals:][single]
    ratio = promised / np.maximum(within, 1e-9)
    return np.asarray(np.where(np.isfinite(ratio), np.maximum(1.0, ratio), 1.0))


class Regression:
    """Estimates of the missing elements of one signal, with their std and state, for samples with the same elements.

    Attributes:
        std: Expected error of every element [unit], shape (size,); NaN for those that are not estimated.
        given: Signals of which some elements are measured.
    """

    def __init__(self, schema: BodySchema, fit: Fit, mask: Mask, finite: np.ndarray) -> None:
        """Prepare for a fit on these measured elements, shape (size,), which are of these signals."""
        self._schema, self._fit, self.given = schema, fit, mask
        self._range, self._about_p = RangeJudge(schema, mask, finite), about_p(schema)
        excess = 1.0 if schema.certainty is None else max(1.0, schema.certainty.excess)
        self.std = np.full(schema.layout.size, np.nan)
        self.std[fit.elements] = fit.std * excess * schema.scaler.std[fit.elements]

    @classmethod
    def of(cls, schema: BodySchema, name: str, finite: np.ndarray) -> "Regression | None":
        """Return the estimates of the missing elements of a signal; None if they are not possible.

        Args:
            schema: The body schema.
            name: The signal, of which some elements are measured.
            finite: Whether each element of the layout is measured, shape (size,).
        """
        span = schema.layout.slices[name]
        elements = span.start + np.flatnonzero(~finite[span])
        if schema.normal is None or len(elements) == span.stop - span.start:
            return None
        fit = fit_of(schema.normal, np.concatenate([finite, np.ones(len(schema.bias), bool)]), elements)
        given = frozenset(s for s, part in schema.layout.slices.items() if finite[part].any())
        return None if fit is None else cls(schema, fit, given, finite)

    def predict(self, joined: np.ndarray, value: np.ndarray) -> None:
        """Write the estimates of the missing elements into a completed sample [unit], shape (size,).

        Args:
            joined: Every element of the layout [unit], shape (size,), NaN where missing.
            value: Result, shape (size,).
        """
        elements, scaler = self._fit.elements, self._schema.scaler
        value[elements] = (self._features(joined) @ self._fit.maps)[0] * scaler.std[elements] + scaler.mean[elements]

    def judge(self, joined: np.ndarray, residual: float, requested: np.ndarray, std: np.ndarray) -> Judgement:
        """Write the std of the estimates, and return their judgement; the arguments are those of `Judge.judge`."""
        elements = self._fit.elements
        std[elements] = self._fit.growth(self._features(joined))[0] * self.std[elements]
        judgement = self._range.judge(joined, residual, requested, std)
        return Judgement(worse(judgement.sureness, self._about_p), judgement.inside)

    def _features(self, joined: np.ndarray) -> np.ndarray:
        schema = self._schema
        return self._fit.reading.features(np.concatenate([schema.scaler.normalise(joined), schema.bias])[None])
