"""The estimation loop: stale values are masked, estimated, and marked as estimated."""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from gemuco.compiled.usable import usable
from gemuco.estimation import fill
from gemuco.intervals.sureness import DOUBTFUL, SURE, Sureness
from gemuco.schema import BodySchema
from gemuco.trust.aligned import Aligned, Interpolated
from hal.by_signal import Elements, Numbers, Truths
from hal.clock import Clock
from hal.config import RobotConfig
from services.model.fusion import Fusion
from services.model.living_model import layout_of
from services.model.ways import Ways
from services.wire.messages import Estimates, Sample
from services.wire.streams import Arrival

ALIGNED_FOR = 1.0
"""Values that were measured at one time are used for this time [s]; then the newest ones are, which may not be."""
WRONG = 3.0
"""An estimate is doubtful if the errors of its element were this many times as large as learned, while it was seen."""

SampleSource = Callable[[], Arrival[Sample] | None]
"""A function of this type returns the newest sample, of any age."""


@dataclass(frozen=True, slots=True, eq=False)
class Distrust:
    """Hidden elements; a change makes another object.

    Attributes:
        hidden: Whether each element of the model is hidden, shape (size,).
        reasons: `signal.element` -> reason, such as `distrusted: frozen since 12:03:11`.
    """

    hidden: np.ndarray
    reasons: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether no element is hidden."""
        return not self.hidden.any()


class Dated(NamedTuple):
    """The usable values of one process.

    Attributes:
        time: Time of measurement [monotonic s of this process]; NaN without a sample.
        values: All elements of the model [unit], shape (size,), NaN where not usable; the same array until they change.
        at: Time at which each of them was measured [monotonic s], shape (size,); NaN where not known.
    """

    time: float
    values: np.ndarray
    at: np.ndarray


class Freshness:
    """The usable values of the newest samples of the HAL and the camera; stale and invalid elements are masked.

    A value may be as old as its signal's `stale_after` when it is published, and the sample may be delayed by the same
    time, as happens on a busy machine. With the default of 20 ms a silent sensor is noticed within 40 ms. Each signal
    is taken only from the process that the robot file gives as its source.
    """

    def __init__(
        self,
        robot: RobotConfig,
        newest: SampleSource,
        clock: Clock,
        seen: SampleSource | None = None,
        names: Iterable[str] = (),
    ) -> None:
        """Prepare for the model's signals.

        Args:
            robot: The robot file.
            newest: Returns the newest sample of the HAL, of any age.
            clock: Source of time.
            seen: Returns the newest sample of the camera's process, of any age.
            names: The model's signals in its own order; by default in that of the robot file.
        """
        self.elements = Elements.of({name: robot.signals[name].size for name in names or layout_of(robot).names})
        self._hal = _Source(robot, self.elements, "hal")
        self._vision = None if seen is None else _Source(robot, self.elements, "vision")
        self._newest, self._seen, self._clock = newest, seen, clock
        nothing = _unwritable(np.full(self.elements.size, np.nan))
        self._nothing = nothing, False
        self._joined: tuple[np.ndarray, np.ndarray, Numbers] = nothing, nothing, Numbers(nothing, self.elements)
        self.distrust = Distrust(np.zeros(self.elements.size, bool))
        """These elements are not used as measured."""
        self._aligned: tuple[float, Numbers] | None = None
        """Time at which they were set [s], and the newest values that were measured at one time."""
        self._trusted, self._trusted_aligned = _Rest(), _Rest()

    def take(self) -> tuple[Arrival[Sample] | None, Numbers]:
        """Return the HAL's newest sample, and all usable values [unit], shapes (n,).

        Values are NaN where they are invalid, stale or distrusted. The sample is None if no value of it is usable;
        values of the camera may be usable then. The arrays are read-only: the same object is returned until another
        sample comes, a value becomes stale, or the distrust changes. Any thread may call this.
        """
        fresh, values = self.measured()
        return fresh, self._trusted.of(values, self.distrust)

    def together(self) -> tuple[Arrival[Sample] | None, Numbers]:
        """Return the same as `take`, but with a camera or slow sensors values that were measured at one time.

        A camera reports later than encoders, so the newest values of a moving robot do not belong together: at 2 rad/s
        the hand moves by centimetres in this time. They are older than the newest ones by the delay of the camera.
        """
        fresh, values = self.take()
        aligned = self._aligned
        if fresh is None or aligned is None or self._clock.monotonic() - aligned[0] > ALIGNED_FOR:
            return fresh, values
        return fresh, self._trusted_aligned.of(aligned[1], self.distrust)

    def align(self, values: Numbers) -> None:
        """Take the newest values that were measured at one time, of a robot with a camera or slow sensors."""
        _unwritable(values.flat)
        self._aligned = self._clock.monotonic(), values

    @property
    def has_camera(self) -> bool:
        """Whether the robot has a camera."""
        return self._vision is not None

    def measured(self) -> tuple[Arrival[Sample] | None, Numbers]:
        """Return the same as `take`, with the values of distrusted elements."""
        now, fresh = self._clock.monotonic(), self._newest()
        measured, is_there = self._nothing if fresh is None else self._hal.usable(fresh, now)
        seen = self._nothing[0]
        if self._vision is not None and self._seen is not None and (shot := self._seen()) is not None:
            seen, _ = self._vision.usable(shot, now)
        joined = self._joined
        if joined[0] is not measured or joined[1] is not seen:
            both = measured if seen is self._nothing[0] else np.where(np.isnan(measured), seen, measured)
            joined = self._joined = measured, seen, Numbers(_unwritable(both), self.elements)
        return (fresh if is_there else None), joined[2]

    def apart(self) -> tuple[Dated, Dated | None]:
        """Return the values of the HAL and those of the camera, as `measured`; None if the robot has no camera."""
        now, fresh = self._clock.monotonic(), self._newest()
        hal = self._dated(self._hal, fresh, now)
        if self._vision is None or self._seen is None:
            return hal, None
        return hal, self._dated(self._vision, self._seen(), now)

    def _dated(self, source: "_Source", arrival: Arrival[Sample] | None, now: float) -> Dated:
        if arrival is None:
            return Dated(math.nan, self._nothing[0], self._nothing[0])
        age = arrival.message.age.flat
        youngest = float(np.min(age, initial=math.inf, where=np.isfinite(age)))
        values, _ = source.usable(arrival, now)
        at = arrival.received - source.ages(arrival.message)
        return Dated(arrival.received - (youngest if math.isfinite(youngest) else 0.0), values, at)


class OneTime:
    """The samples of a robot whose values were all measured at one time, although a camera and slow sensors are late.

    One thread asks for them.
    """

    def __init__(self, freshness: Freshness) -> None:
        """Prepare for the samples of a source."""
        self._freshness = freshness
        self._interpolated, self._aligned = Interpolated(freshness.elements.size), Aligned()
        self._hal, self._camera = np.zeros(0), np.zeros(0)

    @property
    def is_late(self) -> bool:
        """Whether the values are older than the newest ones."""
        return self._freshness.has_camera or self._interpolated.is_late

    def rows(self, now: float) -> list[Numbers]:
        """Return the new ones at a time [monotonic s], oldest first; values are NaN where they are missing."""
        hal, camera = self._freshness.apart()
        is_new, self._hal = hal.values is not self._hal, hal.values
        if is_new and math.isfinite(hal.time):
            self._interpolated.add(hal.time, hal.values, hal.at)
        dated = self._interpolated.take(now)
        rows = [row for _, row in dated]
        if camera is not None:
            for time, row in dated:
                self._aligned.add(time, row)
            if camera.values is not self._camera and math.isfinite(camera.time):
                self._camera = camera.values
                self._aligned.see(camera.time, camera.values)
            rows = self._aligned.take(now)
        return [Numbers(row, self._freshness.elements) for row in rows]


class _Rest:
    """Values without the distrusted ones; the same object for the same values and distrust."""

    def __init__(self) -> None:
        self._last: tuple[Numbers, Distrust, Numbers] | None = None

    def of(self, values: Numbers, distrust: Distrust) -> Numbers:
        """Return the values, NaN where distrusted."""
        if distrust.is_empty:
            return values
        last = self._last
        if last is None or last[0] is not values or last[1] is not distrust:
            rest = Numbers(_unwritable(np.where(distrust.hidden, np.nan, values.flat)), values.elements)
            last = self._last = values, distrust, rest
        return last[2]


class _Source:
    """The usable values of the samples of one process."""

    def __init__(self, robot: RobotConfig, elements: Elements, source: str) -> None:
        self._elements, self._names = (
            elements,
            [n for n in elements.counts if (n in robot.seen) == (source == "vision")],
        )
        stale = [np.full(count, robot.signals[name].stale_after) for name, count in elements.counts.items()]
        self._stale_after = np.concatenate(stale)
        self._limits = sorted({robot.signals[name].stale_after for name in self._names})
        """Values become stale after these times [s]."""
        self._layout: tuple[Elements, tuple[np.ndarray, np.ndarray]] | None = None
        self._read: tuple[Sample, np.ndarray, bool] | None = None
        """This holds the last sample, its usable values when it was published, and whether there was any."""
        self._kept: tuple[np.ndarray, int, np.ndarray, bool] | None = None

    def usable(self, fresh: Arrival[Sample], now: float) -> tuple[np.ndarray, bool]:
        """Return all elements of the model [unit], shape (size,), NaN where not usable; and whether any is usable."""
        read, kept = self._read, self._kept
        if read is None or read[0] is not fresh.message:
            read = self._read = fresh.message, *self._published(fresh.message)
        _, published, is_any = read
        passed = bisect_left(self._limits, now - fresh.received)
        if not passed:
            return published, is_any
        if kept is None or kept[0] is not published or kept[1] != passed:
            left = self._limits[passed] if passed < len(self._limits) else math.inf
            values = _unwritable(np.where(self._stale_after >= left, published, np.nan))
            kept = self._kept = published, passed, values, bool(np.isfinite(values).any())
        return kept[2], kept[3]

    def ages(self, sample: Sample) -> np.ndarray:
        """Return the age of all elements of the model [s], shape (size,); NaN where it is not known."""
        source, target = self._layout_of(sample)
        ages = np.full(self._elements.size, np.nan)
        ages[target] = sample.age.flat[source]
        return np.where(np.isfinite(ages), ages, np.nan)

    def _layout_of(self, sample: Sample) -> tuple[np.ndarray, np.ndarray]:
        layout = self._layout
        if layout is None or layout[0] is not sample.elements:
            layout = self._layout = sample.elements, self._places(sample.elements)
        return layout[1]

    def _published(self, sample: Sample) -> tuple[np.ndarray, bool]:
        """Return the values that were usable when the sample was published, and whether there was any."""
        places = self._layout_of(sample)
        row = np.empty(self._elements.size)
        values, valid, age = sample.values.flat, sample.valid.flat, sample.age.flat
        is_any = usable(values, valid, age, *places, self._stale_after, row)
        return _unwritable(row), is_any

    def _places(self, sent: Elements) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of the model's elements in a sample, and here; a signal of another size is ignored."""
        names = [name for name in self._names if sent.counts.get(name) == self._elements.counts[name]]
        source, target = ([np.r_[elements.places[name]] for name in names] for elements in (sent, self._elements))
        empty = np.zeros(0, int)
        return np.concatenate([empty, *source]), np.concatenate([empty, *target])


def _unwritable(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


def in_order(schema: BodySchema, values: Numbers) -> Numbers:
    """Return the values in the order of the schema's layout, which may differ from that of the robot file."""
    if tuple(values.elements.counts) == schema.layout.names:
        return values
    ordered = Numbers.of(values, Elements.of({signal.name: signal.size for signal in schema.layout.signals}))
    _unwritable(ordered.flat)
    return ordered


def widened(
    schema: BodySchema, sureness: dict[str, Sureness], estimated: np.ndarray, factor: np.ndarray
) -> dict[str, Sureness]:
    """Return the states; a signal that was predicted badly while it was measured is doubtful."""
    if not (bad := estimated & (factor > WRONG)).any():
        return sureness
    states = dict(sureness)
    for name, span in schema.layout.slices.items():
        if bad[span].any() and states[name] is SURE:
            worst = schema.layout.element(span.start + int(np.argmax(factor[span] * bad[span])))
            text = (
                f"while it was measured, the errors of {worst} were {factor[span].max():.1f} times as large as learned"
            )
            states[name] = Sureness(DOUBTFUL, text)
    return states


class Estimation:
    """The source of one `Estimates` per tick, from the newest sample."""

    def __init__(
        self,
        freshness: Freshness,
        schema: Callable[[], BodySchema],
        publish: Callable[[Estimates], None],
        clock: Clock,
        factor: Callable[[], np.ndarray | None] = lambda: None,
        fusion: Fusion | None = None,
        is_known: Callable[[BodySchema], bool] = lambda schema: True,
    ) -> None:
        """Prepare.

        Args:
            freshness: Source of samples.
            schema: Returns the body schema in use.
            publish: Publishes the estimates.
            clock: Source of time.
            factor: Returns the factors on the std of the schema's elements, shape (size,), if there are any.
            fusion: Combines measurements with estimates; without it they are published as measured.
            is_known: Whether the normal errors of a schema are known to be those of this body.
        """
        self._freshness, self._schema, self._publish, self._clock = freshness, schema, publish, clock
        self._factor, self._fusion, self.ways = factor, fusion, Ways(is_known)
        self._source: tuple[BodySchema, Numbers, np.ndarray | None] | None = None
        """This holds the schema, the values and the factors of `latest`."""
        self._newest: Sample | None = None
        self._waited: float | None = None
        self.latest: Estimates | None = None

    def tick(self) -> None:
        """Publish measured values, and estimates of the others; equal input is computed once."""
        now = self._clock.monotonic()
        fresh, values = self._freshness.take()
        self._waited = None if fresh is None or fresh.message is self._newest else now - fresh.received
        self._newest = None if fresh is None else fresh.message
        schema, stamp_ns = self._schema(), self._clock.now_ns()
        cycle = -1 if fresh is None else fresh.message.cycle
        source, factor = self._source, self._factor()
        is_same = source is not None and source[0] is schema and source[1] is values and source[2] is factor
        if self.latest is not None and is_same:
            self.latest = replace(self.latest, stamp_ns=stamp_ns, cycle=cycle)
        else:
            self.latest = _estimates(
                schema,
                self.ways,
                in_order(schema, values),
                factor,
                self._fusion,
                stamp_ns,
                cycle,
                self._freshness.distrust,
            )
            self._source = schema, values, factor
        self._publish(self.latest)

    def waited(self) -> float | None:
        """Return the waiting time [s] of the HAL's sample at the start of the last tick; None if it was not new."""
        return self._waited

    def counts(self) -> dict[str, int]:
        """Count the signals that were `measured`, `estimated`, or neither (`none`) in the last tick."""
        methods = list(self.latest.method.values()) if self.latest is not None else []
        measured, none = methods.count("measured") + methods.count("fused"), methods.count("none")
        return {"measured": measured, "estimated": len(methods) - measured - none, "none": none}


def _estimates(
    schema: BodySchema,
    ways: Ways,
    values: Numbers,
    factor: np.ndarray | None,
    fusion: Fusion | None,
    stamp_ns: int,
    cycle: int,
    distrust: Distrust,
) -> Estimates:
    recipe = ways.at_hand(schema, np.isfinite(values.flat))
    value, std, residual, sureness, _ = fill(schema, values.flat, recipe)
    if factor is not None and recipe.steps:
        std, sureness = std * factor, widened(schema, sureness, recipe.estimated, factor)
    method = dict(recipe.method)
    if fusion is not None:
        value, std, is_fused = fusion.fuse(schema, values.flat, value, std, factor)
        for name, span in schema.layout.slices.items():
            if method[name] == "measured" and is_fused[span].any():
                method[name] = "fused"
    elements = values.elements
    return Estimates(
        stamp_ns=stamp_ns,
        cycle=cycle,
        elements=elements,
        values=Numbers(value, elements),
        estimated=Truths(recipe.estimated, elements),
        std=Numbers(std, elements),
        method=method,
        mask=dict(recipe.label),
        residual=residual,
        state={name: sure.state for name, sure in sureness.items()},
        reason={name: sure.reason for name, sure in sureness.items() if sure.reason},
        distrusted=dict(distrust.reasons),
    )
