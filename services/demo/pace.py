"""Choose a rate that this machine keeps with time to spare, and make a robot file with it."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import yaml

from gemuco.compiled.blas import cores
from hal.config import RatesConfig, RobotConfig
from services.client import Client
from services.errors import ServiceError
from services.wire.messages import Status

LOOK = 2.0
"""The cycles are counted for this long [s]; the HAL reports its counts once a second."""
MOST_SKIPPED, MOST_INCOMPLETE, MOST_REFUSED = 0.02, 0.1, 0.02
"""A machine keeps a rate if at most these shares of the cycles are skipped or lack an answer, and of the commands are
refused because they come too late. Drives and sensors tolerate some missed cycles, and a story with 17 % of them was
green; a machine that is fast enough misses none."""
HALVINGS = 2
"""The rate is halved at most this often: commands need at least a quarter of 200 Hz."""
FEW_CORES, CALM_RATE, RATE_WITH_PAGE = 2, 100.0, 50.0
"""With at most this number of processor cores the story begins with at most these rates [Hz], without and with a page:
at 200 Hz the muscle-driven arm takes 1.7 cores, so that every stall of the machine would stop the robot. A browser that
draws the page without a graphics card takes most of a core."""


@dataclass(frozen=True, slots=True)
class CycleCounts:
    """Cycles of the HAL and commands during a time.

    Attributes:
        rate: Rate of the robot file [Hz].
        cycles: Number of completed cycles.
        skipped: Number of cycles skipped for lack of time.
        incomplete: Number of cycles in which a device did not answer in time.
        late: 99th percentile of the cycles' lateness [s].
        commands: Number of commands that the HAL got.
        refused: Number of them that it refused.
    """

    rate: float
    cycles: int
    skipped: int
    incomplete: int
    late: float
    commands: int
    refused: int

    @classmethod
    def between(cls, before: Status, after: Status) -> "CycleCounts":
        """Return the counts between two statuses of the HAL."""
        first, last = before.loops["hal"], after.loops["hal"]
        earlier, later = before.facts["commands"], after.facts["commands"]
        refused = int(later["refused"]) - int(earlier["refused"])
        return cls(
            rate=last["rate_wanted"],
            cycles=int(last["ticks"] - first["ticks"]),
            skipped=int(last["skipped"] - first["skipped"]),
            incomplete=int(after.facts["incomplete"]) - int(before.facts["incomplete"]),
            late=last["late_p99"],
            commands=int(later["accepted"]) - int(earlier["accepted"]) + refused,
            refused=refused,
        )

    @property
    def is_kept(self) -> bool:
        """Whether this machine keeps the rate."""
        if self.cycles <= 0:
            return False
        is_regular = self.skipped <= MOST_SKIPPED * (self.cycles + self.skipped)
        is_complete = self.incomplete <= MOST_INCOMPLETE * self.cycles
        return is_regular and is_complete and self.refused <= MOST_REFUSED * self.commands

    def __str__(self) -> str:
        return (
            f"{self.skipped} of {self.cycles + self.skipped} cycles were skipped and {self.incomplete} incomplete, "
            f"99 of 100 began within {1e3 * self.late:.1f} ms, {self.refused} of {self.commands} commands were refused"
        )


def count_cycles(client: Client, wait: Callable[[Callable[[], bool], float], bool]) -> CycleCounts:
    """Count the cycles of the HAL for `LOOK` seconds; while the robot is engaged they are those of the story.

    Args:
        client: Client of the robot.
        wait: `Actor.wait`.

    Raises:
        ServiceError: The HAL publishes no status.
    """
    before = _newest(client)
    wait(lambda: False, LOOK)
    wait(lambda: _newest(client).stamp_ns > before.stamp_ns, LOOK)
    return CycleCounts.between(before, _newest(client))


def _newest(client: Client) -> Status:
    status = client.status("hal", timeout=1.0)
    if status is None:
        raise ServiceError("The HAL publishes no status any more; see the logs.")
    return status


def rates_to_try(rates: RatesConfig, with_page: bool) -> list[RatesConfig]:
    """Return the rates of the robot file, their halves and quarters; on a machine of few cores without fast ones."""
    calm = RATE_WITH_PAGE if with_page else CALM_RATE
    tried = [rates]
    for _ in range(HALVINGS):
        tried.append(halved(tried[-1]))
    if cores() <= FEW_CORES:
        return [slower for slower in tried if slower.hal <= calm] or tried[-1:]
    return tried


def halved(rates: RatesConfig) -> RatesConfig:
    """Return half the rates for loops in step with the HAL; slower loops keep their rate, but at most the HAL's."""
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
    """Yield the path of a robot file with other rates, which is beside the original until the context ends.

    Signals of the HAL stay valid for the same number of cycles. The model stays the same, since the robot's fingerprint
    does not include rates.

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
    with ExitStack() as stack:
        try:  # names with a dot in the stem are not listed as robot files
            name = f"{path.stem}.{rates.hal:g}_hz."
            file = stack.enter_context(NamedTemporaryFile("w", prefix=name, suffix=path.suffix, dir=path.parent))
            yaml.safe_dump(described, file)
            file.flush()
        except OSError as error:
            raise ServiceError(
                f"A robot file at {rates.hal:g} Hz cannot be written beside {path}: {error.strerror}."
            ) from None
        yield Path(file.name)
