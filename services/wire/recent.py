"""How long ago a question was asked, on the clock of the one who is asked: it names the newest sample that it had seen.

A link that was cut delivers late what waited in it. Clocks of two machines are not compared, as with commands.
"""

import math

from hal.clock import Clock
from services.errors import TooLate
from services.wire.caller import Caller
from services.wire.messages import Sample

WITHIN = 1.0
"""Age [s] of the sample that a question had seen, up to which what moves a robot is still done."""


class Cycles:
    """The HAL's memory of when its last cycles were."""

    def __init__(self, rate: float, boot: int, clock: Clock) -> None:
        """`rate` [Hz] of the cycle; `boot` of this run of the HAL."""
        self._times = [-math.inf] * max(2, math.ceil(2 * WITHIN * rate))
        self._newest = 0
        self._boot, self._clock = boot, clock

    def note(self, cycle: int, now: float) -> None:
        """This cycle happens now [monotonic s]."""
        self._times[cycle % len(self._times)] = now
        self._newest = cycle

    def check(self, caller: Caller) -> None:
        """Raise `TooLate` unless the question had seen a sample of the last `WITHIN` seconds."""
        newest, cycle = self._newest, caller.cycle
        is_known = caller.hal_boot == self._boot and newest - len(self._times) < cycle <= newest
        age = self._clock.monotonic() - self._times[cycle % len(self._times)] if is_known else math.inf
        refuse_late(caller, self._boot, age)


def age_of(cycle: int, hal_boot: int, newest: Sample, waited: float, rate: float) -> float:
    """How long ago [s] a cycle was, for one who is not the HAL and goes by the newest sample that it has.

    Args:
        cycle: Of the sample that the question or the target had seen.
        hal_boot: Its run of the HAL.
        newest: The newest sample that arrived here.
        waited: How long ago [s] that one arrived.
        rate: Of the HAL's cycle [Hz].

    Returns:
        inf for a sample of another run, or one that cannot have been yet.
    """
    age = waited + (newest.cycle - cycle) / rate
    return age if hal_boot == newest.boot and age > -WITHIN else math.inf


def refuse_late(caller: Caller, boot: int, age: float) -> None:
    """Raise `TooLate` if a question had seen no sample of this run of the HAL that is young enough [s]."""
    if age <= WITHIN:
        return
    if not caller.hal_boot:
        why = "it does not tell which sample of the HAL it had seen (`hal_boot` and `cycle` beside the question)"
    elif caller.hal_boot != boot:
        why = "the newest sample that it had seen is of another run of the HAL"
    elif math.isfinite(age):
        why = f"the newest sample that it had seen was {age:.1f} s old when it came"
    else:
        why = f"there is no cycle {caller.cycle} in the last {WITHIN:g} s"
    raise TooLate(f"What may move the robot is done at once or not at all: {why}. Is the link slow? Ask again.")
