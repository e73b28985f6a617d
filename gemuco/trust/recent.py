"""The newest blocks of samples, and their errors under any hypothesis about which columns are wrong."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gemuco.schema import BodySchema
from gemuco.trust.aligned import Shift, changes
from gemuco.trust.changes import LONGEST
from gemuco.trust.config import BLOCK, Hidden
from gemuco.trust.jumps import Jumps, Repeats
from gemuco.trust.relations import Relations, rows_of
from gemuco.trust.sensitivity import Sensed

JERKS = 0.5
"""Noise of an element exceeds this share of the noise in what the others predict of it."""
NOISY = 5
"""The noise is the median of this number of the newest blocks."""
ENOUGH, LARGER = 10, 1.5
"""Errors that were larger than learned before a change are usual: from the first number of blocks on, and in so far as
they were larger than the second multiple."""
FREE = 1.5
"""Where the errors are more than this multiple of the usual ones, a value changes while the others rest."""
KEPT = 64
"""The errors under this number of hypotheses are kept, those that were asked for last."""
SETTLING = 10
"""The errors of a posture are the mean of the first this many blocks at rest."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Errors of the newest blocks if some columns are hidden.

    Attributes:
        z: Errors [those of a healthy body], oldest first, shape (LONGEST, n); NaN where a used element was missing.
        healthy: Errors of a healthy body [standard deviations of the signal], shape (LONGEST, n).
        timing: Errors of values that are not quite of one time, in the unit of `z`, shape (LONGEST, n).
        late: Changes of the newest errors if one signal is measured `TIMING` later, same unit, shape (signals, n).
        noises: Variance of the noise within each of the `NOISY` newest blocks [squared errors of a healthy body], shape
            (blocks, n); NaN where unknown.
        hidden: The hidden columns.
        settled: Errors when the body had come to the posture in which it rests, in the unit of `z`, shape (n,); NaN
            where unknown, where a value does not follow from the posture, and in motion.
        away: Distance of all other columns from that posture [looks at a new posture], shape (n,).
        moved: Motion up to each block [looks at a new posture], shape (LONGEST,).
        samples: Number of samples in the newest block.
    """

    z: np.ndarray
    healthy: np.ndarray
    timing: np.ndarray
    late: np.ndarray
    noises: np.ndarray
    hidden: Hidden
    settled: np.ndarray
    away: np.ndarray
    moved: np.ndarray
    samples: int

    @property
    def noise(self) -> np.ndarray:
        """Median of `noises`, shape (n,); NaN if half of a column is unknown; a step within one block is no noise."""
        count, ordered = np.isfinite(self.noises).sum(axis=0), np.sort(self.noises, axis=0)  # NaN is the last
        columns, middle = np.arange(len(count)), np.maximum(count - 1, 0)
        median = 0.5 * (ordered[middle // 2, columns] + ordered[(middle + 1) // 2, columns])
        return np.where(2 * count > len(ordered), median, np.nan)

    def standard(self, scale: np.ndarray) -> np.ndarray:
        """Return the errors in the standard deviations of this body and of the timing, shape (LONGEST, n).

        Args:
            scale: This body's errors [unit of `z`], shape (n,).
        """
        return np.asarray(self.z / np.hypot(scale, self.timing))

    def usual(self, scale: np.ndarray, age: int) -> np.ndarray:
        """Return which multiple of a healthy body's the errors were before the newest blocks, at least 1, shape (n,).

        Args:
            scale: A healthy body's errors [unit of `z`], shape (n,).
            age: Number of the newest blocks.
        """
        before = self.standard(scale)[: max(LONGEST - age, 0)] / LARGER
        known = np.isfinite(before)
        count = known.sum(axis=0)
        square = (np.where(known, before, 0.0) ** 2).sum(axis=0) / np.maximum(count, 1)
        return np.where(count >= ENOUGH, np.sqrt(np.maximum(square, 1.0)), 1.0)

    def scaled(self, usual: np.ndarray) -> "View":
        """Return the same errors, if these multiples of a healthy body's errors are usual, shape (n,)."""
        z, timing, late, settled = (part / usual for part in (self.z, self.timing, self.late, self.settled))
        return replace(self, z=z, healthy=self.healthy * usual, timing=timing, late=late, settled=settled)


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """Samples of one block: mean, features of mean and samples, range and absence of every column, network errors.

    `shift` says what is different in it if a signal is measured later.
    """

    mean: np.ndarray
    features: np.ndarray
    each: np.ndarray
    span: np.ndarray
    missing: np.ndarray
    sensed: Sensed
    shift: Shift


class _Errors(NamedTuple):
    """Errors of the newest blocks while some columns are hidden, oldest first.

    Attributes:
        newest: Number of the newest of them.
        errors: Errors [standard deviations of the signal], shape (blocks, columns).
        healthy: Those of a healthy body, shape (blocks, columns).
        late: Their changes if one signal is measured `TIMING` later, shape (blocks, signals, columns).
        noises: As in `View`.
    """

    newest: int
    errors: np.ndarray
    healthy: np.ndarray
    late: np.ndarray
    noises: np.ndarray


class Recent:
    """The newest blocks."""

    def __init__(self, signals: int) -> None:
        """Begin without blocks, for this number of signals, whose values are of one time."""
        self.blocks: deque[_Block] = deque(maxlen=LONGEST)
        self._count = 0
        self._errors: dict[Hidden, _Errors] = {}
        self._moved: deque[float] = deque([0.0] * LONGEST, maxlen=LONGEST)
        self._settling: list[_Block] = []
        self._settled: _Block | None = None
        self._away = np.zeros(1)
        self._schema: BodySchema
        """This is the schema of the newest block."""
        self._samples = np.zeros((0, 0))
        self._last: np.ndarray | None = None
        """The last sample of the block before, shape (1, columns)."""
        self.jumps, self.repeats = Jumps(), Repeats()
        self.usual: dict[Hidden, np.ndarray] = {}
        """Multiples of a healthy body's errors that are usual while these columns are hidden, shape (columns,)."""
        self.lag, self.apart = np.zeros(signals), np.zeros((signals, signals))
        """Multiple of `-TIMING` by which each signal is usually late, and covariance of their times beyond it."""
        self.resting = 0
        """This number of blocks ago the body had settled at its posture; 0 in motion."""

    def add(self, schema: BodySchema, relations: Relations, samples: np.ndarray, pause: float = BLOCK) -> None:
        """Add the newest block.

        Args:
            schema: The schema.
            relations: Its relations.
            samples: Samples [standard deviations], shape (n, size), NaN where missing.
            pause: Time since the block before [s].
        """
        self._schema = schema
        rows = rows_of(schema, samples)[:, relations.columns]
        since = rows if self._last is None else np.concatenate([self._last, rows])
        self._samples, self._last = rows[:, : relations.count], rows[-1:]
        self.jumps.add(self._samples, pause)
        finite = np.isfinite(rows)
        missing = finite.sum(axis=0) * 2 < len(rows)
        whole = rows[finite[:, ~missing].all(axis=1)]
        mean = np.full(rows.shape[1], np.nan)
        mean[~missing] = np.nan_to_num(np.nanmean(rows[:, ~missing], axis=0)) if (~missing).any() else 0.0
        span = np.full(rows.shape[1], np.nan)
        span[~missing] = np.ptp(np.where(finite, rows, mean)[:, ~missing], axis=0)
        late, (halves, weights) = changes(since, relations.signals), _halves(whole)
        along = np.where(missing, np.nan, np.concatenate([mean[None], halves]))
        features = relations.features(relations.rows(schema, np.concatenate([along, mean + late, whole])))
        own, shifted, each = np.split(features, [len(along), len(along) + len(late)])
        sensed = relations.sensitivity.along(schema, relations.rows(schema, along), weights)
        shift = Shift(late[None], shifted[None] - own[:1])
        self.blocks.append(_Block(mean, weights @ own, each, span, missing, sensed, shift))
        self._count += 1

    def rest(self, motion: float, looks: Callable[[float], float]) -> None:
        """Notice whether the body rests at one posture since the newest block was added.

        The column that changed most does not count: it may be a sensor that drifts. The others are held against it,
        and not against each other: it may as well be a value that changes while they rest.

        Args:
            motion: Motion in the newest block [looks at a new posture].
            looks: Returns how many looks at a new posture a distance [standard deviations] is worth.
        """
        newest = self.blocks[-1]
        self._moved.append(self._moved[-1] + motion)
        if self._settling:
            square = np.nan_to_num((newest.mean - self._settling[0].mean) ** 2)
            count, first = np.count_nonzero(np.isfinite(newest.mean)), int(square.argmax())
            others = (square.sum() - square[first]) / max(count - 1, 1)
            self._away = np.full(len(square), looks(float(np.sqrt(square.sum() / max(count, 1)))))
            self._away[first] = looks(float(np.sqrt(others)))
            if count < 2 or self._away[first] >= 1.0:
                self.unsettle()
        if self._settled is not None:
            self.resting += 1
        elif self._settling and not np.array_equal(newest.missing, self._settling[0].missing):
            self._settling = [newest]
        else:
            self._settling.append(newest)
            if len(self._settling) == SETTLING:
                self._settled = _mean(self._settling)

    def unsettle(self) -> None:
        """Forget the posture in which the body rests."""
        self._settling, self._settled, self._away, self.resting = [], None, np.zeros(1), 0

    def under(self, schema: BodySchema, relations: Relations) -> "Recent":
        """Return the same blocks with the p of another schema; their noise is unknown."""
        return self._read_as(schema, relations, self.values())

    def exchanged(self, schema: BodySchema, relations: Relations, one: int, other: int) -> "Recent":
        """Return the same blocks with the values of two columns exchanged; their noise is unknown."""
        return self._read_as(schema, relations, exchanged(schema, relations, self.values(), one, other))

    def _read_as(self, schema: BodySchema, relations: Relations, values: np.ndarray) -> "Recent":
        """Return the same blocks with other means [standard deviations], shape (blocks, columns), and a schema's p."""
        other = Recent(len(self.lag))
        other._moved, other._schema, other.lag, other.apart = self._moved.copy(), schema, self.lag, self.apart
        full = relations.rows(schema, values)
        features, sensed = relations.features(full), relations.sensitivity.sense(schema, full)
        none = np.zeros((0, features.shape[1]))
        for number, block in enumerate(self.blocks):
            own = Sensed(*(part[number : number + 1] for part in sensed))
            mean = full[number, relations.columns]
            other.blocks.append(replace(block, mean=mean, features=features[number], each=none, sensed=own))
        return other

    def missing(self) -> Hidden:
        """Return the columns that are missing in the newest block."""
        return frozenset(np.flatnonzero(self.blocks[-1].missing).tolist())

    def moved(self) -> float:
        """Return the root mean square change of all columns in the newest block; 0 if unknown."""
        if len(self.blocks) < 2:
            return 0.0
        change = self.blocks[-1].mean - self.blocks[-2].mean
        change = change[np.isfinite(change)]
        return float(np.sqrt(np.mean(change**2))) if len(change) else 0.0

    def values(self) -> np.ndarray:
        """Return the means of the newest blocks [standard deviations], shape (blocks, columns)."""
        return np.array([block.mean for block in self.blocks])

    def spans(self) -> np.ndarray:
        """Return the range of every column within each of the newest blocks, shape (blocks, columns)."""
        return np.array([block.span for block in self.blocks])

    def view(self, relations: Relations, hidden: Hidden) -> View:
        """Return the errors with some columns hidden."""
        used = np.ones(len(relations.columns), bool)
        used[list(hidden)] = False
        known, missing = self._errors_without(relations, hidden), np.array([block.missing for block in self.blocks])
        healthy = known.healthy * self.usual.get(hidden, 1.0)
        z = (known.errors - np.einsum("s,bsn->bn", self.lag, known.late)) / healthy
        timing = np.sqrt(np.maximum((known.late * (self.apart @ known.late)).sum(axis=1), 0.0)) / healthy
        z[np.any(missing & used, axis=1)] = np.nan
        z[missing] = np.nan
        if len(z) < LONGEST:
            lacking = np.full((LONGEST - len(z), z.shape[1]), np.nan)
            z, healthy, timing = (np.concatenate([lacking, part]) for part in (z, healthy, timing))
        settled, moved = self._errors_when_settled(relations, hidden, used), np.array(self._moved) - self._moved[-1]
        settled = np.where(self._away < 1.0, settled, np.nan)
        return View(
            z, healthy, timing, known.late[-1] / healthy[-1], known.noises, hidden, settled, self._away, moved,
            len(self.blocks[-1].each),
        )  # fmt: skip

    def _errors_without(self, relations: Relations, hidden: Hidden) -> _Errors:
        """Return the errors with some columns hidden; only those of blocks that are new are computed."""
        before = self._errors.pop(hidden, None)
        fresh = len(self.blocks) if before is None else min(self._count - before.newest, len(self.blocks))
        if before is None or fresh == len(self.blocks):
            known = _Errors(self._count, *self._judged(relations, hidden, list(self.blocks)))
        elif fresh:
            own = self._judged(relations, hidden, list(self.blocks)[-fresh:])
            kept = zip(before[1:], own, (LONGEST, LONGEST, LONGEST, NOISY), strict=True)
            known = _Errors(self._count, *(np.concatenate([old, new])[-most:] for old, new, most in kept))
        else:
            known = before
        while len(self._errors) >= KEPT:
            del self._errors[next(iter(self._errors))]
        self._errors[hidden] = known
        return known

    def _judged(self, relations: Relations, hidden: Hidden, blocks: Sequence[_Block]) -> tuple[np.ndarray, ...]:
        """Return the errors of some blocks, and what is known of those of a healthy body; see `_Errors`."""
        features = np.array([block.features for block in blocks])
        sensed = Sensed.joined(block.sensed for block in blocks)
        means = np.array([block.mean for block in blocks])
        shift = Shift.joined(block.shift for block in blocks)
        judged = relations.judged(self._schema, hidden, features, sensed, means, shift)
        relation, newest = relations.without(hidden), blocks[-NOISY:]
        noises = np.array([_noise(block.each, relation.maps) for block in newest])
        return judged.errors, judged.healthy, judged.late, noises / relation.healthy(features[-NOISY:]) ** 2

    def find_repeats(self, view: View, scale: np.ndarray, motion: float) -> None:
        """Find the elements that are stuck after the newest block.

        Args:
            view: The errors.
            scale: A healthy body's errors [unit of the view], shape (columns,).
            motion: Motion in the newest block [looks at a new posture].
        """
        used = slice(self._samples.shape[1])
        self.repeats.add(self._samples, motion, self.predicted(view)[used], (view.healthy[-1] * scale)[used])

    def predicted(self, view: View) -> np.ndarray:
        """Return what the others predict of each column in the newest block [standard deviations], shape (columns,)."""
        return np.asarray(self.blocks[-1].mean - view.z[-1] * view.healthy[-1])

    def _errors_when_settled(self, relations: Relations, hidden: Hidden, used: np.ndarray) -> np.ndarray:
        """Return `View.settled`; `used` are the columns that are not hidden."""
        settled = self._settled
        if settled is None or (settled.missing & used).any():
            return np.full(len(used), np.nan)
        judged = relations.judged(
            self._schema, hidden, settled.features[None], settled.sensed, settled.mean[None], settled.shift
        )
        is_unknown = settled.missing | (judged.size[0] > FREE)
        return np.where(is_unknown, np.nan, (judged.errors / judged.healthy)[0] / self.usual.get(hidden, 1.0))

    def clear(self) -> None:
        """Forget all blocks."""
        self.blocks.clear()
        self._errors.clear()
        self.usual.clear()
        self.jumps, self.repeats = Jumps(), Repeats()
        self.unsettle()


def exchanged(schema: BodySchema, relations: Relations, values: np.ndarray, one: int, other: int) -> np.ndarray:
    """Return values [standard deviations], shape (n, columns), with those of two columns in each other's place."""
    result, pair = values.copy(), [one, other]
    std, mean = schema.scaler.std[relations.columns[pair]], schema.scaler.mean[relations.columns[pair]]
    result[:, pair[::-1]] = (values[:, pair] * std + mean - mean[::-1]) / std[::-1]
    return result


def _halves(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of both halves of a block, shape (2, columns), and weights of its mean and of these.

    The mean of an arm's postures is none of its postures: in a fast motion what follows from it differs from the mean
    of what follows from each sample. What follows from all three, weighted, is that mean if the motion is even and the
    function of second order.
    """
    half = len(rows) // 2
    if not half:
        return rows[:0], np.ones(1)
    places = np.arange(len(rows)) - 0.5 * (len(rows) - 1)
    bend = np.mean(places**2) / np.mean(places[-half:]) ** 2
    halves = np.stack([rows[:half].mean(axis=0), rows[-half:].mean(axis=0)])
    return halves, np.array([1.0 - bend, 0.5 * bend, 0.5 * bend])


def _mean(blocks: Sequence[_Block]) -> _Block:
    """Return the mean of blocks at one posture with the same missing columns, without single samples."""
    features = np.mean([block.features for block in blocks], axis=0)
    parts = zip(*(block.sensed for block in blocks), strict=True)
    sensed = Sensed(*(np.mean(part, axis=0) for part in parts))
    mean = np.mean([block.mean for block in blocks], axis=0)
    return replace(blocks[-1], mean=mean, features=features, each=np.zeros((0, len(features))), sensed=sensed)


def _noise(features: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Return the variance of what is not smooth in successive errors, shape (columns,); NaN of fewer than three.

    Errors that change with the posture are smooth in time; the second difference of white noise has six times its
    variance. A jerk of the body is in the prediction too, and counts `JERKS` times as large there.
    """
    if len(features) < 3:
        return np.full(maps.shape[1], np.nan)
    bends = np.diff(features, n=2, axis=0)
    error = bends @ maps
    predicted = bends[:, 1 : 1 + maps.shape[1]] - error
    return np.asarray(np.maximum(np.mean(error**2 - JERKS * predicted**2, axis=0), 0.0) / 6.0)
