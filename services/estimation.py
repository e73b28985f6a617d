"""The estimation loop: stale is masked, estimated, and marked as estimated."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

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
    """What of the newest sample may be used now."""

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
        values: dict[str, np.ndarray] = {}
        for name, size in self._sizes.items():
            value = fresh.sample.values.get(name)
            if value is None or value.shape != (size,):
                values[name] = np.full(size, np.nan)
                continue
            usable = fresh.sample.valid[name] & (fresh.sample.age[name] + waited <= self._stale_after[name])
            values[name] = np.where(usable, value, np.nan)
        if not any(np.isfinite(value).any() for value in values.values()):
            return None, values
        return fresh, values


class Estimation:
    """Makes one `Estimates` per tick from the newest sample."""

    def __init__(
        self, freshness: Freshness, schema: Callable[[], BodySchema], publish: Callable[[Estimates], None]
    ) -> None:
        """`schema` returns the body schema in use at the moment."""
        self._freshness = freshness
        self._schema = schema
        self._publish = publish
        self.latest: Estimates | None = None

    def tick(self) -> None:
        """Publish what is measured, and estimates in place of what is not."""
        fresh, values = self._freshness.take()
        self.latest = estimates(self._schema(), values, -1 if fresh is None else fresh.sample.cycle)
        self._publish(self.latest)


def estimates(schema: BodySchema, values: Mapping[str, np.ndarray], cycle: int) -> Estimates:
    """Every signal of the schema, measured where `values` has a number and estimated where it has not."""
    found = schema.estimate(values)
    names = schema.layout.names
    return Estimates(
        cycle=cycle,
        values={name: found[name].value for name in found},
        estimated={name: found[name].estimated for name in found},
        std={name: found[name].std for name in found},
        method={name: found[name].method for name in found},
        mask={name: "+".join(part for part in names if part in found[name].mask) for name in found},
        residual={name: float(found[name].residual) for name in found},
    )
