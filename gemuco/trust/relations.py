"""Prediction of every element, and of p, from the others with any set of them hidden, and a healthy body's errors.

A wrong element disturbs the predictions of all others. Hidden, it disturbs none; so every hypothesis about what is
wrong needs predictions without it. They all follow from the second moments of the watch.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gemuco.anomaly.prediction import judging_masks, with_bias
from gemuco.intervals.beyond import line_of
from gemuco.intervals.region import learned_range
from gemuco.normal.local import Grid, LocalSize
from gemuco.normal.watch import error_growth, without_features
from gemuco.schema import BodySchema
from gemuco.trust.aligned import Shift
from gemuco.trust.config import Hidden, TrustConfig
from gemuco.trust.sensitivity import LINEAR, Sensed, Sensitivity

STRAIGHT, CURVED, FURTHEST = 2.0, 6.0, 5.0
"""Outside of the learned range of an element, by a share of it, the network's errors are larger by the exponential of
the first multiple of the share if all outputs are linear, else of the second; the share counts up to the third number.
"""
NEARBY = 0.05
"""The network's errors are computed anew if a hidden element is off by more than this [standard deviations]."""
KEPT = 64
"""At most this number of relations is kept."""
TWIN = 6.0
"""Two elements are twins if the healthy error of each is this multiple, or more, without the other."""
FLOOR = 0.002
"""A healthy error is at least this share of the spread of its column in the known samples."""
HARDLY = 0.1
"""An element hardly varies if its spread is below this share of the largest one of its signal. `FLOOR` is then a share
of that one: sensors of one signal resolve alike, and the element may stay within one of their steps."""


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """Prediction of every judged column from all columns but itself and the hidden ones.

    Attributes:
        maps: Features of the watch -> measured minus predicted [standard deviations], shape (features, columns).
        mean: Mean error of a healthy body, shape (columns,).
        std: Its standard deviation at the mean distance from the known samples, shape (columns,).
        spread: Inverse of the moments of the used features, shape (features, features), zero elsewhere.
        places: Features that contain each column, shape (columns, places).
        removal: Takes these features out of the distance from the known samples, shape (columns, places, places).
        distance: Mean distance of the known samples.
        network: Whether the network's errors say more of each column than the watch does, shape (columns,).
        calibration: Healthy errors of the lies that these suggest, in their own standard deviations, shape (columns,).
        by_watch: Size of the watch's healthy errors at each sample.
        by_network: Size of the healthy errors of these lies.
        usual: Median size of the healthy errors, of whichever is known better, shape (columns,).
    """

    maps: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    spread: np.ndarray
    places: np.ndarray
    removal: np.ndarray
    distance: np.ndarray
    network: np.ndarray
    calibration: np.ndarray
    by_watch: LocalSize
    by_network: LocalSize
    usual: np.ndarray

    def errors(self, features: np.ndarray) -> np.ndarray:
        """Return measured minus predicted [standard deviations], shape (n, columns).

        Args:
            features: Features of samples, shape (n, features), zero where they cannot be computed.
        """
        return np.asarray(features @ self.maps - self.mean)

    def healthy(self, features: np.ndarray) -> np.ndarray:
        """Return a healthy body's standard deviation of the errors of samples, shape (n, columns).

        It grows with the distance of the other columns from the known samples: a wrong value does not excuse itself.
        """
        return np.asarray(self.growth(self.far(features)) * self.std)

    def growth(self, far: np.ndarray) -> np.ndarray:
        """Return how much larger the errors are at a distance from the known samples, shape (n, columns)."""
        return error_growth(far, self.distance)

    def far(self, features: np.ndarray) -> np.ndarray:
        """Return the distance of the other columns from the known samples, shape (n, columns)."""
        scaled = features @ self.spread
        own = np.ascontiguousarray(scaled.T[self.places].transpose(0, 2, 1))
        removed = np.einsum("cnk,cnk->nc", own @ self.removal, own)
        return np.asarray((np.einsum("ij,ij->i", features, scaled)[:, None] - removed).clip(min=0.0))


class Judged(NamedTuple):
    """Errors of samples with some columns hidden [standard deviations of the signal].

    Attributes:
        errors: The errors, shape (n, columns).
        healthy: Those of a healthy body whose values are of one time, shape (n, columns).
        size: Its multiple of the usual one, larger where a value follows less from the others, shape (n, columns).
        late: Change of the errors if all elements of one signal are changed by `shift`, shape (n, signals, columns).
    """

    errors: np.ndarray
    healthy: np.ndarray
    size: np.ndarray
    late: np.ndarray


class Relations:
    """All relations of one schema; each is computed at its first use."""

    def __init__(self, schema: BodySchema) -> None:
        """Prepare, for a schema whose normal errors have a watch."""
        assert schema.normal is not None and schema.normal.watch is not None
        watch = self._watch = schema.normal.watch
        judged = watch.signal >= 0
        self.count = int(judged.sum())
        """This is the number of judged elements; the columns after them are p."""
        self.columns = watch.inputs
        """Positions of all judged columns: elements in the layout, ascending, then p behind the layout's size."""
        self.signals = watch.signal
        """Number of the signal of each column; negative for p."""
        inputs = len(watch.inputs)
        first, second = watch.reading(None, maps=False).pairs
        self._holds = np.zeros((len(watch.moments), inputs), bool)
        self._holds[1 + np.arange(inputs), np.arange(inputs)] = True
        products = 1 + inputs + np.arange(len(first))
        self._holds[products, first] = self._holds[products, second] = True
        penalties = watch.penalties[: self.count]
        self._penalty = np.concatenate([penalties, np.full(inputs - self.count, np.median(penalties))])
        self._inverse = {float(penalty): watch.inverse(float(penalty)) for penalty in set(self._penalty)}
        rows = schema.normal.rows.astype(float)
        self._rows, self._known = self.features(rows), rows
        self.sensitivity = Sensitivity(schema, self.columns)
        self.is_linear = _is_linear(schema)
        """Whether every output is linear, so that it is right outside of what was learned too."""
        self._steepness = STRAIGHT if self.is_linear else CURVED
        self._sensed = self.sensitivity.sense(schema, rows)
        self._coarse = FLOOR * _signal_spreads(schema, rows, self.columns, watch.signal)
        self._least = np.maximum(FLOOR * np.maximum(rows[:, self.columns].std(axis=0), 1e-3), self._coarse)
        self._kept: dict[Hidden, Relation] = {}
        self._inflation = np.ones(inputs)
        self._grid = Grid.of(np.nan_to_num(rows[:, self.columns]))
        self._sizes: tuple[LocalSize | None, LocalSize | None] = None, None
        outputs = schema.out_layout.size
        promised = np.sqrt(np.diag(schema.normal.covariance))[outputs : outputs + self.count]
        whole = self.without(frozenset())
        self._sizes = whole.by_watch, whole.by_network
        ratio = promised / whole.std[: self.count]
        self._inflation = np.maximum(1.0, np.concatenate([ratio, np.full(inputs - self.count, np.median(ratio))]))
        self._kept.clear()

    @classmethod
    def of(cls, schema: BodySchema) -> "Relations | None":
        """Return the relations of a schema, or None if what is normal for it is not known."""
        normal = schema.normal
        is_possible = normal is not None and normal.watch is not None and len(normal.rows) > 0
        return cls(schema) if is_possible else None

    def rows(self, schema: BodySchema, values: np.ndarray) -> np.ndarray:
        """Return samples with a schema's p from values of the judged columns, NaN elsewhere [standard deviations]."""
        rows = np.full((len(values), schema.layout.size + len(schema.bias)), np.nan)
        rows[:, self.columns] = values
        rows[:, schema.layout.size :] = schema.bias
        return rows

    def features(self, rows: np.ndarray) -> np.ndarray:
        """Return the features of samples and their p, zero where an element is not finite: (n, features)."""
        return np.asarray(np.nan_to_num(self._watch.reading(None, maps=False).features(rows)))

    def sizes(self, schema: BodySchema, config: TrustConfig) -> np.ndarray:
        """Return from which size on a lie of each column matters [errors of a healthy prediction], shape (columns,)."""
        sizes = np.full(len(self.columns), config.size)
        for name, size in config.sizes.items():
            span = schema.layout.slice(name)
            sizes[(self.columns >= span.start) & (self.columns < span.stop)] = size
        return sizes

    def without(self, hidden: Hidden) -> Relation:
        """Return the relation that uses none of the hidden columns."""
        known = self._kept.pop(hidden, None) or self._relation(hidden)
        while len(self._kept) >= KEPT:
            del self._kept[next(iter(self._kept))]
        self._kept[hidden] = known
        return known

    def are_twins(self, first: int, second: int, hidden: Hidden) -> bool:
        """Whether hardly anything but each other predicts two columns, so the others cannot say which of them lies."""
        usual = self.without(hidden).usual
        pair = ((first, second), (second, first))
        return all(self.without(hidden | {gone}).usual[left] >= TWIN * usual[left] for gone, left in pair)

    def _relation(self, hidden: Hidden) -> Relation:
        inputs, away = len(self.columns), np.zeros(len(self.columns), bool)
        away[list(hidden)] = True
        outside = np.asarray(self._holds[:, away].any(axis=1))
        kept = {penalty: without_features(inverse, outside) for penalty, inverse in self._inverse.items()}
        maps = np.zeros((len(self._holds), inputs))
        for index in range(inputs):
            inverse = kept[float(self._penalty[index])]
            own = self._holds[:, index] & ~outside
            if away[index]:  # predicted by the features without all hidden ones; their inverse has no entry of its own
                maps[:, index] = self._prediction(index, outside, self._inverse[float(self._penalty[index])])
            else:
                block = inverse[own]
                unit = (np.flatnonzero(own) == 1 + index).astype(float)
                maps[:, index] = np.linalg.solve(block[:, own], unit) @ block
                maps[own, index] = 0.0
            maps[1 + index, index] = 1.0
        spread = next(iter(kept.values()))
        places = np.array([np.flatnonzero(self._holds[:, index]) for index in range(inputs)])
        removal = np.array([_removal(spread, own, outside) for own in places])
        zero, one = np.zeros(inputs), np.ones(inputs)
        even = LocalSize.even(inputs)
        draft = Relation(maps, zero, one, spread, places, removal, one, zero > 0.0, one, even, even, one)
        far = draft.far(self._rows)
        draft = replace(draft, distance=np.maximum(far.mean(axis=0), 1e-9))
        growth, errors = draft.growth(far), draft.errors(self._rows)
        mean = errors.mean(axis=0)
        std = np.sqrt(np.mean(((errors - mean) / growth) ** 2, axis=0)) * self._inflation
        std = np.maximum(std, self._least)
        spread, calibration, ratio = self._by_network(hidden, np.maximum(1.0, growth))
        by_watch = LocalSize.fit(self._grid, (errors - mean) / (growth * std), hidden, self._sizes[0])
        by_network = LocalSize.fit(self._grid, ratio / calibration, hidden, self._sizes[1])
        values = self._known[:, self.columns]
        sizes = growth * std * by_watch(values), spread * calibration * by_network(values)
        medians = np.median(sizes, axis=1)
        return replace(
            draft,
            mean=mean,
            std=std,
            network=medians[1] < medians[0],
            calibration=calibration,
            by_watch=by_watch,
            by_network=by_network,
            usual=medians.min(axis=0),
        )

    def _by_network(self, hidden: Hidden, factor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what the network says of each column at the known samples.

        Args:
            hidden: The hidden columns.
            factor: Growth of errors with the distance from the known samples, shape (samples, columns).

        Returns:
            Standard deviations of the lies that its errors suggest [standard deviations], shape (samples, columns),
            infinite where they say nothing, their calibration, shape (columns,), and the lies of the healthy body
            [their standard deviations], shape (samples, columns), NaN where unknown.
        """
        lies, spread = self.sensitivity.lies(self._sensed, hidden, limit=np.inf)
        away = sorted(hidden)
        far = (np.abs(lies[:, away]) > LINEAR).any(axis=1)
        # the largest errors of the hidden columns count: without them all others would be expected too small
        spread[np.ix_(far, np.delete(np.arange(spread.shape[1]), away))] = np.inf
        spread = spread * factor
        known = np.isfinite(spread)
        ratio = np.where(known, lies, 0.0) / np.where(known, spread, 1.0)
        calibration = np.maximum(1.0, np.sqrt((ratio**2).sum(axis=0) / np.maximum(known.sum(axis=0), 1)))
        return spread, calibration, np.where(known, ratio, np.nan)

    def judged(
        self,
        schema: BodySchema,
        hidden: Hidden,
        features: np.ndarray,
        sensed: Sensed,
        values: np.ndarray,
        shift: Shift | None = None,
    ) -> Judged:
        """Return the errors of samples with some columns hidden, and what is known of those of a healthy body.

        Each error is that of the watch, or the lie that the network's errors suggest, whichever is known better.

        Args:
            schema: The schema.
            hidden: The hidden columns.
            features: Features of the samples, shape (n, features).
            sensed: Errors of the network at the samples.
            values: Values of the judged columns, p included [standard deviations], shape (n, columns).
            shift: What is different in them if a signal is measured later; by default nothing is, as at rest.
        """
        relation = self.without(hidden)
        errors, healthy = relation.errors(features), relation.healthy(features)
        growth, size = healthy / relation.std, relation.by_watch(values)
        healthy = np.maximum(healthy * size, self._least)
        late = np.zeros((len(values), 1, len(self.columns))) if shift is None else shift.features @ relation.maps
        if relation.network.any():
            sensed, off = self._sensed_without(schema, hidden, errors, sensed, values)
            lies, spread = self.sensitivity.lies(sensed, hidden)
            lies = lies + off
            by_network = relation.by_network(values)
            spread = spread * relation.calibration * np.maximum(1.0, growth) * by_network
            spread = np.maximum(spread, self._coarse)
            better = relation.network & np.isfinite(spread)
            spread *= self.outside(schema, values, errors, np.where(better, lies, errors))
            errors, healthy = np.where(better, lies, errors), np.where(better, spread, healthy)
            size = np.where(better, by_network, size)
            if shift is not None and shift.values.any():
                own = self.sensitivity.moved(sensed, hidden, shift.values)
                late = np.where(better[:, None], own, late)
        return Judged(errors, healthy, size, late)

    def outside(self, schema: BodySchema, values: np.ndarray, *errors: np.ndarray) -> np.ndarray:
        """Return how much larger the network's errors are at samples outside of the learned ranges, shape (n, 1).

        A sample is outside if the others predict an element there too; a sensor that only shows such a value says
        nothing of the body.

        Args:
            schema: The schema.
            values: Values of the judged columns [standard deviations], shape (n, columns).
            errors: Their errors in each way to predict them, shape (n, columns).
        """
        low, high = (edge[self.columns[: self.count]] for edge in schema.derived(learned_range))
        places = (values - np.stack([np.zeros(values.shape), *errors]))[..., : self.count]
        over = np.fmax((low - places).min(axis=0), (places - high).min(axis=0)) / (high - low)
        share = np.nan_to_num(over).clip(0.0, FURTHEST).max(axis=1, initial=0.0, keepdims=True)
        return np.asarray(np.exp(self._steepness * share))

    def _sensed_without(
        self, schema: BodySchema, hidden: Hidden, errors: np.ndarray, sensed: Sensed, values: np.ndarray
    ) -> tuple[Sensed, np.ndarray]:
        """Return the errors of the network with the watch's predictions in place of hidden elements that are far off.

        The network's derivatives hold near the truth only: at a wrong value of a hidden element the errors of all
        others would be wrong too, the more so the larger its lie is.

        Returns:
            The errors, and the correction that was taken off every column, shape (n, columns).
        """
        elements, off = sorted(column for column in hidden if column < self.count), np.zeros(errors.shape)
        off[:, elements] = np.where(np.isfinite(values[:, elements]), errors[:, elements], 0.0)
        far = np.abs(off).max(axis=1, initial=0.0) > NEARBY
        off[~far] = 0.0
        if not far.any():
            return sensed, off
        rows = self.rows(schema, (values - off)[far])
        rows[:, self.columns] = (values - off)[far]  # also the p of each sample, if another tool has come since
        again = self.sensitivity.sense(schema, rows)
        result = Sensed(*(part.copy() for part in sensed))
        for part, new in zip(result, again, strict=True):
            part[far] = new
        return result, off

    def beyond(self, schema: BodySchema, values: np.ndarray) -> Hidden:
        """Return the judged elements whose values are outside of what was learned.

        Args:
            schema: The schema.
            values: Values of the judged columns [standard deviations], shape (columns,).
        """
        judged, (low, high) = self.columns[: self.count], learned_range(schema)
        own = values[: self.count]
        return frozenset(np.flatnonzero((own < low[judged]) | (own > high[judged])).tolist())

    def _prediction(self, index: int, outside: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Return the map of the error of a hidden column, which the features with hidden columns do not enter."""
        unit = (np.flatnonzero(outside) == 1 + index).astype(float)
        result = np.zeros(len(inverse))
        block = inverse[outside]
        result[~outside] = np.linalg.solve(block[:, outside], unit) @ block[:, ~outside]
        return result


def rows_of(schema: BodySchema, x: np.ndarray) -> np.ndarray:
    """Return samples [standard deviations], shape (n, size), followed by the schema's p."""
    return with_bias(schema, x)


def _is_linear(schema: BodySchema) -> bool:
    """Whether every output is linear under the mask that judges it."""
    lines = ((name, line_of(schema, mask)) for name, mask in schema.derived(judging_masks).items())
    return all(line is not None and set(schema.layout.indices([name])) <= set(line.outputs) for name, line in lines)


def _signal_spreads(schema: BodySchema, rows: np.ndarray, columns: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return the largest spread in the signal of columns that hardly vary [their standard deviations]; 0 for others.

    Args:
        schema: The schema.
        rows: Known samples with their p [standard deviations], shape (n, size + bias_size).
        columns: Positions of the columns in a row, shape (columns,).
        signal: Number of each column's signal; negative for p, shape (columns,).
    """
    result = np.zeros(len(columns))
    for number in set(signal[signal >= 0].tolist()):
        own = signal == number
        std = schema.scaler.std[columns[own]]
        spread = rows[:, columns[own]].std(axis=0) * std
        result[own] = np.where(spread < HARDLY * spread.max(), spread.max() / std, 0.0)
    return result


def _removal(spread: np.ndarray, own: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Return the matrix that takes some features out of the distance; zero for those that are out already."""
    result, kept = np.zeros((len(own), len(own))), ~outside[own]
    if kept.any():
        result[np.ix_(kept, kept)] = np.linalg.inv(spread[np.ix_(own[kept], own[kept])])
    return result
