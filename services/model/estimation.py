"""The estimation loop: stale is masked, estimated, and marked as estimated."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import is_

import numpy as np
from msgspec.structs import replace

from gemuco.masks import label
from gemuco.schema import BodySchema
from hal.clock import Clock
from hal.config import RobotConfig, SignalConfig
from services.model.living_model import layout_of
from services.wire.messages import Estimates, Sample
from services.wire.streams import Newest as Reader


@dataclass(frozen=True, slots=True)
class Fresh:
    """A sample and when it arrived.

    Attributes:
        sample: As it was sent.
        received: This process's monotonic time [s]; ages go on from here, for two clocks are never compared.
    """

    sample: Sample
    received: float

    @classmethod
    def of(cls, reader: Reader[Sample]) -> "Fresh | None":
        """The last sample that arrived at a reader, however old."""
        last = reader.last()
        return None if last is None else cls(last[1], last[0])


Newest = Callable[[], Fresh | None]
Usable = dict[str, np.ndarray]
"""Signal -> values [unit], shape (n,); NaN where they must not be used."""


class Freshness:
    """What of the newest samples, the HAL's and the camera's, may be used now.

    A value may be as old as its signal's `stale_after` when it is published, and the sample may wait as long again on
    its way and here, since that happens on a busy machine. With the default of 20 ms a silent sensor is noticed within
    40 ms. Each signal is taken from the process that the robot file says is its source, and from no other.
    """

    def __init__(self, robot: RobotConfig, newest: Newest, clock: Clock, seen: Newest | None = None) -> None:
        """Prepare for the model's signals.

        Args:
            robot: The robot file.
            newest: Returns the last sample of the HAL, however old.
            clock: Of this process.
            seen: Returns the last sample of the camera's process, however old.
        """
        self._signals = [(name, robot.signals[name]) for name in layout_of(robot).names]
        self._newest: dict[str, Newest | None] = {"hal": newest, "vision": seen}
        self._clock = clock
        self._absent = {name: _unwritable(np.full(signal.size, np.nan)) for name, signal in self._signals}
        self._read: dict[str, tuple[Sample, Usable]] = {}
        """For each source the sample that was read last, and what of it could be used when it was published."""

    def take(self) -> tuple[Fresh | None, dict[str, np.ndarray]]:
        """The HAL's newest sample, and all usable values [unit], shapes (n,); NaN where invalid or stale by now.

        The sample is None if nothing of it is usable; what the camera sees may be usable then. Nobody may write into
        the arrays: they are the same until another sample comes.
        """
        newest = {source: None if take is None else take() for source, take in self._newest.items()}
        usable = {source: {} if fresh is None else self._usable(source, fresh) for source, fresh in newest.items()}
        now = self._clock.monotonic()
        values, alive = dict(self._absent), False
        for name, signal in self._signals:
            fresh, found = newest[signal.source], usable[signal.source].get(name)
            if fresh is not None and found is not None and now - fresh.received <= signal.stale_after:
                values[name] = found
                alive = alive or signal.source == "hal"
        return newest["hal"] if alive else None, values

    def _usable(self, source: str, fresh: Fresh) -> Usable:
        """The signals of which something could be used when a sample was published, NaN where it could not."""
        read = self._read.get(source)
        if read is None or read[0] is not fresh.sample:
            found = {name: _valid(name, signal, fresh.sample) for name, signal in self._signals}
            read = fresh.sample, {name: value for name, value in found.items() if np.isfinite(value).any()}
            self._read[source] = read
        return read[1]


def _valid(name: str, signal: SignalConfig, sample: Sample) -> np.ndarray:
    """The values of one signal, NaN where they were not valid or too old already when they were published."""
    value, valid, age = sample.values.get(name), sample.valid.get(name), sample.age.get(name)
    shape = (signal.size,)
    if value is None or valid is None or age is None or not value.shape == valid.shape == age.shape == shape:
        return np.full(signal.size, np.nan)
    return _unwritable(np.where(valid & (age <= signal.stale_after), value, np.nan))


def _unwritable(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


class Estimation:
    """Makes one `Estimates` per tick from the newest sample."""

    def __init__(
        self,
        freshness: Freshness,
        schema: Callable[[], BodySchema],
        publish: Callable[[Estimates], None],
        clock: Clock,
    ) -> None:
        """`schema` returns the body schema in use at the moment."""
        self._freshness, self._schema, self._publish, self._clock = freshness, schema, publish, clock
        self._told: tuple[BodySchema, tuple[np.ndarray, ...]] | None = None
        """The schema and the values that `latest` was made from."""
        self._newest: Sample | None = None
        self._waited: float | None = None
        self.latest: Estimates | None = None

    def tick(self) -> None:
        """Publish what is measured, and estimates in place of what is not; nothing is computed twice."""
        now = self._clock.monotonic()
        fresh, values = self._freshness.take()
        self._waited = None if fresh is None or fresh.sample is self._newest else now - fresh.received
        self._newest = None if fresh is None else fresh.sample
        schema, stamp_ns = self._schema(), self._clock.now_ns()
        cycle = -1 if fresh is None else fresh.sample.cycle
        arrays = tuple(values.values())
        told = self._told
        if self.latest is not None and told is not None and told[0] is schema and all(map(is_, told[1], arrays)):
            self.latest = replace(self.latest, stamp_ns=stamp_ns, cycle=cycle)
        else:
            self.latest, self._told = _estimates(schema, values, stamp_ns, cycle), (schema, arrays)
        self._publish(self.latest)

    def waited(self) -> float | None:
        """How long [s] the HAL's sample had waited when the last tick began; None if it was not a new one."""
        return self._waited

    def counts(self) -> dict[str, int]:
        """How many signals were `measured`, `estimated` and `none` of both in the last tick."""
        methods = list(self.latest.method.values()) if self.latest is not None else []
        measured, none = methods.count("measured"), methods.count("none")
        return {"measured": measured, "estimated": len(methods) - measured - none, "none": none}


def _estimates(schema: BodySchema, values: Mapping[str, np.ndarray], stamp_ns: int, cycle: int) -> Estimates:
    found = schema.estimate(values)
    names = tuple(found)
    return Estimates(
        stamp_ns=stamp_ns,
        cycle=cycle,
        values={name: one.value for name, one in found.items()},
        estimated={name: one.estimated for name, one in found.items()},
        std={name: one.std for name, one in found.items()},
        method={name: one.method for name, one in found.items()},
        mask={name: label(one.mask, names) for name, one in found.items()},
        residual={name: float(one.residual) for name, one in found.items()},
    )
