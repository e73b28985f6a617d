"""Who is there, and how its loops keep time."""

import math
from dataclasses import dataclass

from services.view.seen import Seen
from services.wire import keys

ALWAYS = ("hal", "model")
"""Services that every robot has; the others are shown once they were heard of."""


@dataclass(frozen=True, slots=True)
class LoopRow:
    """How one loop keeps time: rates [Hz], lateness [s], ticks skipped since start, share of time inside the tick."""

    name: str
    wanted: float
    rate: float
    late: float
    worst: float
    skipped: int
    busy: float


@dataclass(frozen=True, slots=True)
class ServiceRow:
    """One service.

    Attributes:
        state: What its status says; `gone` if its token is not there, `silent` if it is and no status comes, `absent`
            if it was never heard of.
        age: Since its last status [s]; infinite if there was none.
        loops: As of that status.
    """

    name: str
    state: str
    text: str
    age: float
    loops: tuple[LoopRow, ...]

    @property
    def is_there(self) -> bool:
        """Whether what its loops tell is of now."""
        return self.state not in ("gone", "silent", "absent")


def service_rows(seen: Seen) -> tuple[ServiceRow, ...]:
    """Every service that there is, was, or should be."""
    found = []
    for name in keys.SERVICES:
        heard = seen.statuses.get(name)
        if heard is None and name not in seen.alive and name not in ALWAYS:
            continue
        if heard is None:
            found.append(ServiceRow(name, "silent" if name in seen.alive else "absent", "", math.inf, ()))
            continue
        state = heard.message.state
        if name not in seen.alive or not seen.linked:
            state = "gone"
        elif not heard.is_fresh:
            state = "silent"
        loops = tuple(_loop(each, told) for each, told in heard.message.loops.items())
        found.append(ServiceRow(name, state, heard.message.text, heard.age, loops))
    return tuple(found)


def _loop(name: str, told: dict[str, float]) -> LoopRow:
    return LoopRow(
        name,
        told.get("rate_wanted", math.nan),
        told.get("rate", math.nan),
        told.get("late_p99", math.nan),
        told.get("late_max", math.nan),
        int(told.get("skipped", 0)),
        told.get("busy", math.nan),
    )
