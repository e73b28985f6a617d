"""State of each service of a robot, and the timing of its loops."""

import math
from dataclasses import dataclass
from enum import IntEnum

from services.watch.snapshot import RobotSnapshot
from services.wire import keys

LATE = 0.02
"""A loop whose latest tick of the last second began later than this [s] is late."""


class Level(IntEnum):
    """Severity of a trouble, and of a robot by its worst one."""

    GOOD = 0
    NOTE = 1
    """Worth reading."""
    DEGRADED = 2
    """The robot continues without something."""
    ANOMALY = 3
    """The body is not as the model knows it."""
    TROUBLE = 4
    """An operator has to act."""
    GONE = 5
    """The present state of the robot is unknown."""


@dataclass(frozen=True, slots=True)
class LoopRow:
    """Timing of a loop.

    Attributes:
        wanted: Rate in the robot file [Hz].
        rate: Rate in the last second [Hz].
        p50: Median lateness of the recent ticks [s].
        p99: 99th percentile of their lateness [s].
        worst: Their largest lateness [s].
        skipped: Ticks skipped since the start.
        busy: Share of time inside the tick, 0 to 1.
    """

    name: str
    wanted: float
    rate: float
    p50: float
    p99: float
    worst: float
    skipped: float
    busy: float

    @property
    def is_slow(self) -> bool:
        """Whether the rate is more than 5 % below the wanted one; a status covers 1 s, so one tick less is allowed."""
        return self.rate + 1.0 < 0.95 * self.wanted

    @property
    def is_late(self) -> bool:
        """Whether a recent tick began more than 20 ms late."""
        return self.worst > LATE


@dataclass(frozen=True, slots=True)
class ServiceRow:
    """One service.

    Attributes:
        state: State in its status; `gone` if its token disappeared, `silent` if the token is present without a fresh
            status, `absent` if the service was never heard and the robot needs it.
        age: Age of its newest status [s]; infinite if there is none.
        loops: Timing in that status.
    """

    name: str
    state: str
    text: str = ""
    age: float = math.inf
    loops: tuple[LoopRow, ...] = ()

    @property
    def is_present(self) -> bool:
        """Whether the timing of the loops is of the present."""
        return self.state not in ("gone", "silent", "absent")

    @property
    def is_frozen(self) -> bool:
        """Whether the service is alive and stopped publishing its status."""
        return self.state == "silent" and math.isfinite(self.age)

    @property
    def level(self) -> Level:
        """Severity of the state."""
        if self.state in ("running", "ready"):
            return Level.GOOD
        is_missed = self.state in ("gone", "absent") and self.name in ("hal", "model")
        return Level.TROUBLE if is_missed or self.is_frozen or self.state == "fault" else Level.DEGRADED


def needed(snapshot: RobotSnapshot) -> tuple[str, ...]:
    """Return the services that this robot needs: vision only if a status reports a camera."""
    has_camera = any(newest.message.facts.get("camera") for newest in snapshot.statuses.values())
    return ("hal", "model", "vision") if has_camera else ("hal", "model")


def service_rows(snapshot: RobotSnapshot) -> tuple[ServiceRow, ...]:
    """Return a row for every service that is alive, was heard, or is needed."""
    rows = []
    for name in keys.SERVICES:
        newest, is_alive = snapshot.statuses.get(name), name in snapshot.alive and snapshot.linked
        if newest is None:
            if is_alive or name in needed(snapshot):
                rows.append(ServiceRow(name, "silent" if is_alive else "absent"))
            continue
        status = newest.message
        state = status.state if newest.is_fresh else "silent"
        loops = tuple(_loop_row(loop, timing) for loop, timing in status.loops.items())
        rows.append(ServiceRow(name, state if is_alive else "gone", status.text, newest.age, loops))
    return tuple(rows)


def _loop_row(name: str, timing: dict[str, float]) -> LoopRow:
    def figure(key: str) -> float:
        return timing.get(key, math.nan)

    return LoopRow(
        name, figure("rate_wanted"), figure("rate"), figure("late_p50"), figure("late_p99"), figure("late_max"),
        timing.get("skipped", 0.0), figure("busy"),
    )  # fmt: skip
