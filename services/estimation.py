"""The estimation loop: stale is masked, estimated, and marked as estimated."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gemuco.masks import label
from gemuco.schema import BodySchema
from hal.clock import Clock
from hal.config import RobotConfig
from services.messages import Estimates, Sample


@dataclass(frozen=True, slots=True)
class Fresh:
    """A sample and when it arrived.

    Attributes:
        sample: As the HAL sent it.
        received: This process's monotonic time [s]; ages go on from here, for two clocks are never compared.
    """

    sample: Sample
    received: float


Newest = Callable[[], Fresh | None]


class Freshness:
    """What of the newest sample may be used now.

    A value may be as old as its signal's `stale_after` when the HAL publishes it, and the sample may wait as long again
    on its way and here, since that happens on a busy machine. With the default of 20 ms a silent sensor is noticed
    within 40 ms.
    """

    def __init__(self, robot: RobotConfig, newest: Newest, clock: Clock) -> None:
        """`newest` returns the last sample that arrived, however old."""
        self._stale_after = {name: signal.stale_after for name, signal in robot.signals.items()}
        self._sizes = {name: signal.size for name, signal in robot.signals.items()}
        self._newest = newest
        self._clock = clock

    def take(self) -> tuple[Fresh | None, dict[str, np.ndarray]]:
        """The newest sample and its usable values [unit], shapes (n,); NaN where invalid or stale by now."""
        fresh = self._newest()
        if fresh is None:
            return None, {name: np.full(size, np.nan) for name, size in self._sizes.items()}
        waited = self._clock.monotonic() - fresh.received
        sample = fresh.sample
        values: dict[str, np.ndarray] = {}
        for name, size in self._sizes.items():
            value, valid, age = sample.values.get(name), sample.valid.get(name), sample.age.get(name)
            if value is None or valid is None or age is None or not value.shape == valid.shape == age.shape == (size,):
                values[name] = np.full(size, np.nan)
                continue
            values[name] = np.where(valid & (np.maximum(age, waited) <= self._stale_after[name]), value, np.nan)
        if not any(np.isfinite(value).any() for value in values.values()):
            return None, values
        return fresh, values


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
        self.latest: Estimates | None = None

    def tick(self) -> None:
        """Publish what is measured, and estimates in place of what is not."""
        fresh, values = self._freshness.take()
        found = self._schema().estimate(values)
        names = tuple(found)
        self.latest = Estimates(
            stamp_ns=self._clock.now_ns(),
            cycle=-1 if fresh is None else fresh.sample.cycle,
            values={name: found[name].value for name in names},
            estimated={name: found[name].estimated for name in names},
            std={name: found[name].std for name in names},
            method={name: found[name].method for name in names},
            mask={name: label(found[name].mask, names) for name in names},
            residual={name: float(found[name].residual) for name in names},
        )
        self._publish(self.latest)
