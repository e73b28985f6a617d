"""Age of a request, on the clock of the service that receives the request.

A request names the newest sample that its sender received. The age of this sample limits the delay of the request: a
link that was interrupted delivers its queued requests late. The clocks of two machines are never compared.
"""

import math

from hal.clock import Clock
from services.errors import TooLate
from services.wire.caller import Caller
from services.wire.messages import Sample

WITHIN = 1.0
"""A request that may move the robot is refused if its sender's newest sample is older than this [s]."""


class Cycles:
    """Times at which the last cycles of the HAL began."""

    def __init__(self, rate: float, boot: int, clock: Clock) -> None:
        """Prepare for cycles at `rate` [Hz] in the run `boot` of the HAL."""
        self._times = [-math.inf] * max(2, math.ceil(2 * WITHIN * rate))
        self._newest = 0
        self._boot, self._clock = boot, clock

    def note(self, cycle: int, now: float) -> None:
        """Store the time [monotonic s] at which a cycle began."""
        self._times[cycle % len(self._times)] = now
        self._newest = cycle

    def check(self, caller: Caller) -> None:
        """Raise `TooLate` unless the caller received a sample of the last `WITHIN` seconds."""
        newest, cycle = self._newest, caller.cycle
        is_known = caller.hal_boot == self._boot and newest - len(self._times) < cycle <= newest
        age = self._clock.monotonic() - self._times[cycle % len(self._times)] if is_known else math.inf
        refuse_late(caller, self._boot, age)


def age_of(cycle: int, hal_boot: int, newest: Sample, waited: float, rate: float) -> float:
    """Return the age [s] of a cycle of the HAL, from the newest sample that this process has.

    Args:
        cycle: Cycle of the newest sample that the sender of a request received.
        hal_boot: Run of the HAL of that sample.
        newest: The newest sample that arrived here.
        waited: Time since `newest` arrived [s].
        rate: Rate of the HAL's cycle [Hz].

    Returns:
        The age [s]; inf for a sample of another run or of a future cycle.
    """
    age = waited + (newest.cycle - cycle) / rate
    return age if hal_boot == newest.boot and age > -WITHIN else math.inf


def refuse_late(caller: Caller, boot: int, age: float) -> None:
    """Raise `TooLate` if the caller's newest sample has too large an age [s] or is from another run of the HAL."""
    if age <= WITHIN:
        return
    if not caller.hal_boot:
        raise TooLate(
            "The request may move the robot, but does not name its sender's newest sample. Send the `boot` of that "
            "sample as `hal_boot`, and its `cycle`, in the attachment of the query, a msgpack map (docs/keys.md)."
        )
    if caller.hal_boot != boot:
        reason = "its sender's newest sample is from another run of the HAL"
    elif math.isfinite(age):
        reason = f"its sender's newest sample was {age:.1f} s old when the request arrived"
    else:
        reason = f"there was no cycle {caller.cycle} in the last {WITHIN:g} s"
    raise TooLate(f"The request is too late to move the robot: {reason}. Is the link slow?")
