"""Whether this machine keeps the rate of a robot file, and the same robot at half of it where it does not."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import yaml

from hal.config import RatesConfig, RobotConfig
from services.client import Client
from services.errors import ServiceError
from services.wire.messages import Status

LOOK = 4.0
"""How long [s] is looked: a HAL tells how it does once a second."""
MOST_SKIPPED, MOST_INCOMPLETE = 0.02, 0.05
"""Shares of the cycles that may be left out, or be without some answer, at a rate that is kept: drives and sensors
survive a cycle now and then, and a machine that does its work misses none."""
HALVINGS = 2
"""How often the rate is halved at most: a quarter of 200 Hz is as slow as a command may come."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How the HAL kept its rate for a while.

    Attributes:
        rate: What was wanted [Hz].
        cycles: Cycles that were done.
        skipped: Cycles that there was no time for.
        incomplete: Cycles, of those done, in which not every device answered in time.
        late: 99 of 100 cycles began no later than this [s].
    """

    rate: float
    cycles: int
    skipped: int
    incomplete: int
    late: float

    @classmethod
    def between(cls, before: Status, after: Status) -> "Pace":
        """From two statuses of the HAL."""
        then, now = before.loops["hal"], after.loops["hal"]
        return cls(
            rate=now["rate_wanted"],
            cycles=int(now["ticks"] - then["ticks"]),
            skipped=int(now["skipped"] - then["skipped"]),
            incomplete=int(after.facts["incomplete"]) - int(before.facts["incomplete"]),
            late=now["late_p99"],
        )

    @property
    def is_kept(self) -> bool:
        """Whether the rate is one that this machine keeps."""
        if self.cycles <= 0:
            return False
        is_often = self.skipped <= MOST_SKIPPED * (self.cycles + self.skipped)
        return is_often and self.incomplete <= MOST_INCOMPLETE * self.cycles

    def __str__(self) -> str:
        return (
            f"{self.skipped} of {self.cycles + self.skipped} cycles were skipped and {self.incomplete} incomplete, "
            f"99 of 100 began within {1e3 * self.late:.1f} ms"
        )


def look(client: Client, wait: Callable[[Callable[[], bool], float], bool]) -> Pace:
    """Watch the HAL for `LOOK` seconds.

    Args:
        client: Of the robot.
        wait: As `Actor.wait`: for so long [s] or until the condition holds.

    Raises:
        ServiceError: The HAL does not say how it does.
    """
    before = _newest(client)
    wait(lambda: False, LOOK)
    wait(lambda: _newest(client).stamp_ns > before.stamp_ns, LOOK)
    return Pace.between(before, _newest(client))


def _newest(client: Client) -> Status:
    status = client.status("hal", timeout=1.0)
    if status is None:
        raise ServiceError("The HAL does not tell any more how it does; see the logs.")
    return status


def halved(rates: RatesConfig) -> RatesConfig:
    """Half the rate for all that follows the HAL's cycle; the slower loops stay, but none is faster than the cycle."""
    hal = rates.hal / 2
    return RatesConfig(
        hal=hal,
        estimation=rates.estimation / 2,
        anomaly=rates.anomaly / 2,
        control=min(rates.control, hal),
        update=min(rates.update, hal),
    )


@contextmanager
def at_rates(path: Path, robot: RobotConfig, rates: RatesConfig) -> Iterator[Path]:
    """The robot file at other rates, in a file beside it for as long as it is needed.

    What the HAL measures stays valid for as many cycles as before: the same time would be no cycle at all in the end.
    The model stays the one it has, for nothing of this says what the robot is.

    Raises:
        ServiceError: The file cannot be written.
    """
    if rates == robot.rates:
        yield path
        return
    described: dict[str, Any] = yaml.safe_load(path.read_text())
    described["rates"] = rates.model_dump()
    for name, signal in robot.signals.items():
        if signal.source == "hal":
            described["signals"][name] = described["signals"][name] | {
                "stale_after": signal.stale_after * robot.rates.hal / rates.hal
            }
    with ExitStack() as kept:
        try:  # a dot in the stem: listed nowhere as a robot file
            name = f"{path.stem}.{rates.hal:g}_hz."
            file = kept.enter_context(NamedTemporaryFile("w", prefix=name, suffix=path.suffix, dir=path.parent))
            yaml.safe_dump(described, file)
            file.flush()
        except OSError as error:
            raise ServiceError(
                f"A robot file at {rates.hal:g} Hz cannot be written beside {path}: {error.strerror}."
            ) from None
        yield Path(file.name)
