"""Calibration of the certainty of a schema on held-out samples (split conformal, per way to estimate and element)."""

from collections.abc import Mapping

import numpy as np

from gemuco.adaption.innovation import own_bias
from gemuco.adaption.renewal import given_elements, standard_p
from gemuco.certainty.certainty import KNOTS, NINETY, Certainty, Way, features, reach_of
from gemuco.compiled.certainty import novelties
from gemuco.masks import Mask
from gemuco.schema import BodySchema

MOST_PAIRS = 60_000
"""At most this many pairs of sample and mask are measured; the samples are thinned evenly."""
LEAST = 30
"""A way needs at least this many held-out errors of an element for a factor of its own."""
SHARE = 0.9
"""This share of the held-out errors lies within `NINETY` std."""
CAP = 0.99
"""Measures are capped at this quantile of the held-out samples."""
LOWEST = -2.0
"""Standardised measures are at least this."""
LIMITS = (0.98, 0.995)
"""A sample is doubtful, and unknown, beyond these quantiles of the held-out samples."""
ROOM = 1.05
"""The limits are wider than the quantiles by this factor."""
STIFF = 20.0
"""The slopes are shrunk as by this many samples without any slope."""
SMALL = 1e-4
"""Errors below this [standard deviations] count as this."""
PAIRS = 20_000
"""The growth is measured on this many pairs of anchors."""
MEASURES = 4
"""This is the number of measures of a sample's novelty."""


def calibrate(
    schema: BodySchema,
    held: tuple[np.ndarray, np.ndarray],
    training: np.ndarray,
    errors: Mapping[Way, np.ndarray],
) -> Certainty | None:
    """Return the certainty of a schema; None if it has no anchors or no sample can be judged.

    Args:
        schema: The schema with its expected errors.
        held: Held-out samples [standard deviations], shape (n, size), NaN where not measured, and their p, shape
            (n, bias_size).
        training: Samples that were learned from, shape (n, size).
        errors: Errors of single samples [standard deviations] of all ways; see `gemuco.learning.accuracy.ErrorRows`.
    """
    size = schema.layout.size
    low, high, moments = _learned(schema, training)
    ways, parts = [], []
    if not len(schema.anchors) or not len(held[0]):
        return None
    for way in errors:
        if way in schema.errors and (trial := _Trial.of(schema, way, held, moments, (low, high))) is not None:
            ways.append(way)
            parts.append((*trial.calibrated(errors[way]), *_growth(schema, way[1])))
    if not ways:
        return None
    logs, limits, slopes, knots, growth = (np.stack(column) for column in zip(*parts, strict=True))
    assert slopes.shape[1:] == (size, 1 + MEASURES)
    return Certainty(tuple(ways), low, high, moments, logs, limits, slopes, knots, growth)


def _learned(schema: BodySchema, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lowest and highest values of the elements, shape (size,), and the moments of the features."""
    x = rows.copy()
    x[:, schema.scaler.dead] = 0.0
    finite = np.isfinite(x)
    low = np.where(finite, x, np.inf).min(axis=0)
    high = np.where(finite, x, -np.inf).max(axis=0)
    never = low > high
    low[never], high[never] = 0.0, 0.0
    whole = x[finite.all(axis=1)]
    part = features(whole if len(whole) else np.where(finite, x, 0.0))
    return low, high, part.T @ part / len(part)


class _Trial:
    """Held-out samples of one way: their measures, and their errors if the way is a mask."""

    def __init__(self, schema: BodySchema, way: Way, raw: np.ndarray, errors: np.ndarray | None) -> None:
        self._schema, self._way, self._errors = schema, way, errors
        self.logs = np.zeros((MEASURES, 4))
        self.logs[:, 1] = 1.0
        for k in range(MEASURES):
            column = raw[:, k]
            spread = float(column.std())
            if spread > 1e-6:
                z = (column - column.mean()) / spread
                self.logs[k] = column.mean(), spread, LOWEST, max(float(np.quantile(z, CAP)), 0.0)
            else:
                self.logs[k] = column.mean(), 1.0, 0.0, 0.0
        self._z = (raw - self.logs[:, 0]) / self.logs[:, 1]

    @classmethod
    def of(
        cls,
        schema: BodySchema,
        way: Way,
        held: tuple[np.ndarray, np.ndarray],
        moments: np.ndarray,
        edges: tuple[np.ndarray, np.ndarray],
    ) -> "_Trial | None":
        """Measure a way; None if no held-out sample has all given signals."""
        method, mask = way
        size = schema.layout.size
        elements = given_elements(schema, mask, np.ones(size, bool))
        usable = np.flatnonzero(np.isfinite(held[0][:, elements]).all(axis=1))
        most = max(200, MOST_PAIRS // max(len(schema.masks), 1))
        usable = usable[np.linspace(0, len(usable) - 1, min(most, len(usable))).astype(int)]
        if not len(usable) or not len(elements):
            return None
        x, p = held[0][usable], held[1][usable]
        errors, residuals = None, np.full(len(x), np.nan)
        if method == "mask":
            filled = np.nan_to_num(x)
            errors = schema.infer(filled, mask, p).astype(float)
            errors -= x[:, schema.out_index]
            residuals = _of_given(schema, mask, errors)
        raw = _measures(schema, mask, moments, edges, (x, p, residuals))
        return cls(schema, way, raw, errors)

    def calibrated(self, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return logs, limits and slopes of the way; see `Certainty`.

        Args:
            errors: Errors of the way on other samples, used if it is a search, shape (samples, elements).
        """
        schema, size = self._schema, self._schema.layout.size
        length = np.sqrt((self._z[:, :3].clip(min=0.0) ** 2).sum(axis=1))
        limits = ROOM * np.quantile(length, LIMITS)
        slopes = np.zeros((size, 1 + MEASURES))
        capped = np.clip(self._z, self.logs[:, 2], self.logs[:, 3])
        known = schema.errors[self._way]
        places = schema.out_index if len(known) == len(schema.out_index) else np.arange(size)
        missed = errors if self._errors is None else self._errors
        for column, element in enumerate(places):
            expected = known[column] / schema.scaler.std[element]
            if expected > 0.0 and np.isfinite(expected):
                z = capped if self._errors is not None else np.zeros((len(missed), MEASURES))
                slopes[element] = fitted(np.abs(missed[:, column]), z, expected)
        return self.logs, limits, slopes


def fitted(missed: np.ndarray, z: np.ndarray, expected: float) -> np.ndarray:
    """Return the slopes of the logarithm of the std, by 1 and the measures, shape (1 + measures,).

    Args:
        missed: Absolute errors [standard deviations], shape (n,), NaN where not measured.
        z: Capped measures, shape (n, measures).
        expected: Expected error [standard deviations].
    """
    result = np.zeros(1 + z.shape[1])
    measured = np.isfinite(missed)
    missed, z = missed[measured], z[measured]
    if len(missed) < LEAST:
        return result
    log = np.log(np.maximum(missed, SMALL))
    rows = np.concatenate([np.ones((len(z), 1)), z], axis=1)
    used = np.arange(1 + z.shape[1])
    while True:  # without negative slopes: nearer to the data an estimate is not worse
        part = rows[:, used]
        ridge = STIFF * np.diag(used > 0)
        slope = np.linalg.solve(part.T @ part + ridge, part.T @ log)
        if len(used) == 1 or not (slope[1:] < 0.0).any():
            break
        used = used[np.concatenate([[True], slope[1:] >= 0.0])]
    result[used] = slope
    result[0] = 0.0
    ratio = missed / (expected * np.exp(rows @ result))
    result[0] = np.log(max(float(np.quantile(ratio, SHARE)) / NINETY, 1e-6))
    return result


def _of_given(schema: BodySchema, mask: Mask, errors: np.ndarray) -> np.ndarray:
    """Return the root mean square of the errors of the given elements, shape (n,); NaN without any."""
    sizes = [schema.layout.signal(name).size for name in schema.x_out]
    given = np.repeat([name in mask for name in schema.x_out], sizes)
    if not given.any():
        return np.full(len(errors), np.nan)
    return np.asarray(np.sqrt(np.mean(np.nan_to_num(errors[:, given]) ** 2, axis=1)))


def _measures(
    schema: BodySchema,
    mask: Mask,
    moments: np.ndarray,
    edges: tuple[np.ndarray, np.ndarray],
    samples: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return the measures of samples before standardisation, shape (n, 4).

    Args:
        schema: The body schema.
        mask: The given signals.
        moments: See `Certainty`.
        edges: Lowest and highest learned values [standard deviations], shape (size,).
        samples: Samples [standard deviations], their p, and the residuals of their given values.
    """
    elements = given_elements(schema, mask, np.ones(schema.layout.size, bool))
    reach = reach_of(schema.anchors, moments, elements)
    ranges = np.ascontiguousarray(np.stack(edges)[:, elements])
    own = standard_p(schema, own_bias(schema, len(schema.anchors)))
    x, p, residuals = (np.ascontiguousarray(part, float) for part in samples)
    measures: np.ndarray = novelties(
        reach.anchors, own.astype(float), reach.precision, elements, ranges, x, standard_p(schema, p), residuals
    )
    return measures


def _growth(schema: BodySchema, mask: Mask) -> tuple[np.ndarray, np.ndarray]:
    """Return distances between anchors, shape (k,), and half their mean squared difference there, shape (k, size).

    The difference is that of the nonlinear parts: the anchors minus their regression on the given elements. It is
    measured on random pairs and on nearest neighbours (the variogram of geostatistics).
    """
    size = schema.layout.size
    anchors = schema.anchors.astype(float)
    elements = given_elements(schema, mask, np.ones(size, bool))
    p = standard_p(schema, own_bias(schema, len(anchors)))
    x = np.concatenate([anchors[:, elements], p], axis=1)
    rows = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    line = np.linalg.solve(rows.T @ rows + 1e-6 * len(rows) * np.eye(rows.shape[1]), rows.T @ anchors)
    rest = anchors - rows @ line
    squared = (x**2).sum(axis=1)[:, None] + (x**2).sum(axis=1) - 2.0 * x @ x.T
    np.fill_diagonal(squared, np.inf)
    near = squared.argmin(axis=1) if len(x) > 1 else np.zeros(1, int)
    random = np.random.default_rng(0)
    one, other = random.integers(0, len(x), (2, PAIRS))
    one, other = one[one != other], other[one != other]
    one, other = np.concatenate([np.arange(len(x)), one]), np.concatenate([near, other])
    distance = np.sqrt(((x[one] - x[other]) ** 2).sum(axis=1))
    half = 0.5 * (rest[one] - rest[other]) ** 2
    parts = np.array_split(np.argsort(distance), KNOTS)
    knots = np.array([distance[part].mean() for part in parts])
    knots = np.maximum.accumulate(np.maximum(knots, 1e-6) + 1e-9 * np.arange(KNOTS))
    return knots, np.maximum.accumulate(np.array([half[part].mean(axis=0) for part in parts]), axis=0)
