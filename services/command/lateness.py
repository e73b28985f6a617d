"""The age of a question on the clock of the service that is asked.

A question names the newest sample that its sender saw. A link that was cut delivers late what waited in it, and the
clocks of two machines are never compared.
"""

import math

from hal.clock import Clock
from services.errors import TooLate
from services.wire.caller import Caller
from services.wire.messages import Sample

WITHIN = 1.0
"""A question that may move the robot is refused if the newest sample its sender saw is older than this [s]."""


class Cycles:
    """The HAL's memory of when its last cycles began."""

    def __init__(self, rate: float, boot: int, clock: Clock) -> None:
        """Prepare for cycles at `rate` [Hz] of the run `boot` of the HAL."""
        self._times = [-math.inf] * max(2, math.ceil(2 * WITHIN * rate))
        self._newest = 0
        self._boot, self._clock = boot, clock

    def note(self, cycle: int, now: float) -> None:
        """Note that this cycle began now [monotonic s]."""
        self._times[cycle % len(self._times)] = now
        self._newest = cycle

    def check(self, caller: Caller) -> None:
        """Raise `TooLate` unless the caller saw a sample of the last `WITHIN` seconds."""
        newest, cycle = self._newest, caller.cycle
        is_known = caller.hal_boot == self._boot and newest - len(self._times) < cycle <= newest
        age = self._clock.monotonic() - self._times[cycle % len(self._times)] if is_known else math.inf
        refuse_late(caller, self._boot, age)


def age_of(cycle: int, hal_boot: int, newest: Sample, waited: float, rate: float) -> float:
    """Return how long ago [s] a cycle of the HAL was, by the newest sample that this process has.

    Args:
        cycle: Cycle of the sample that the sender of a question or target saw.
        hal_boot: Run of the HAL of that sample.
        newest: The newest sample that arrived here.
        waited: Time [s] since that one arrived.
        rate: Rate of the HAL's cycle [Hz].

    Returns:
        The age [s]; inf for a sample of another run, or of a cycle that is still to come.
    """
    age = waited + (newest.cycle - cycle) / rate
    return age if hal_boot == newest.boot and age > -WITHIN else math.inf


def refuse_late(caller: Caller, boot: int, age: float) -> None:
    """Raise `TooLate` if the newest sample of this run of the HAL that the caller saw is too old [s]."""
    if age <= WITHIN:
        return
    if not caller.hal_boot:
        why = "the question does not say which sample of the HAL its sender saw (`hal_boot` and `cycle` beside it)"
    elif caller.hal_boot != boot:
        why = "the newest sample that its sender saw is of another run of the HAL"
    elif math.isfinite(age):
        why = f"the newest sample that its sender saw was {age:.1f} s old when the question came"
    else:
        why = f"there was no cycle {caller.cycle} in the last {WITHIN:g} s"
    raise TooLate(f"A question that may move the robot is answered at once or refused: {why}. Is the link slow?")
