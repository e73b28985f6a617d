"""Lease of a robot: only the client that has the lease, and renews it, commands the robot.

The lease protects clients from commanding at the same time. A client with a false identity is stopped by the roles, not
by the lease.
"""

import math
import secrets
import threading
from dataclasses import dataclass, replace
from typing import Any

from hal.clock import Clock, SystemClock
from services.errors import BadArguments, CommandHeld, LeaseLost
from services.wire.caller import UNKNOWN, Caller
from services.wire.plain_text import shown

LONGEST = 60.0
"""No lease is longer than this [s], so that a client that vanished does not exclude the others for long."""
SHORTEST = 0.2
"""No lease is shorter than this [s], so that it can be renewed in time on a busy machine."""
STREAM = 1.0
"""A client that streams commands without a lease is the holder for this long [s] after its last command."""


@dataclass(frozen=True, slots=True)
class Tenure:
    """Time during which one client commands.

    Attributes:
        caller: The holder; a caller without a boot before the first tenure.
        until: End [monotonic s].
        through: `boot` of the service that commands for the holder; 0 if the holder commands itself.
        number: Secret of the holder, with which it renews and releases its lease; 0 if a stream of commands took it.
            The boots of clients are published, so they prove nothing.
    """

    caller: Caller = UNKNOWN
    until: float = -math.inf
    through: int = 0
    number: int = 0


class Lease:
    """The only lease of a robot, for any thread. Reading it and streaming commands never wait."""

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or SystemClock()
        self._lock = threading.Lock()
        self._tenure = Tenure()
        self._shared = 0
        """`boot` of the service that commands for any client, because its client had no lease; 0 without one."""

    @property
    def tenure(self) -> Tenure | None:
        """The present tenure; None if the robot has no holder."""
        tenure = self._tenure
        return tenure if tenure.caller.boot and self._clock.monotonic() < tenure.until else None

    def left(self) -> float:
        """Return the remaining time of the lease [s]; 0 without a holder."""
        return max(0.0, self._tenure.until - self._clock.monotonic())

    def take(self, caller: Caller, seconds: Any, number: Any = 0) -> Tenure:
        """Give the caller the lease for this time [s] from now; with the same number it may take it again.

        Args:
            caller: The client.
            seconds: Length of the lease [s].
            number: Number that the client chose, so that it may repeat a request whose answer was lost; 0: any.

        A service that was let command by a client without a lease commands for any client, so it gives way.

        Raises:
            CommandHeld: Another client has the lease, or this one under another number.
            BadArguments: The time or the number is not allowed, or the caller has no boot.
        """
        duration = _checked(seconds)
        if type(number) is not int or not 0 <= number < 1 << 53:
            raise BadArguments(f"The number of a lease is a whole number from 1 to 2^53 - 1, not {shown(number)}.")
        if not caller.boot:
            raise BadArguments("A client that takes the lease must send a `boot`, a random number, with its query.")
        with self._lock:
            tenure, until = self.tenure, self._clock.monotonic() + duration
            gives_way = tenure is not None and not tenure.number and tenure.caller.boot == self._shared
            is_other = tenure is not None and (tenure.caller.boot != caller.boot or tenure.number not in (0, number))
            if tenure is not None and is_other and not gives_way:
                raise self._refusal(tenure)
            through = 0 if tenure is None or gives_way else tenure.through
            self._tenure = Tenure(caller, until, through, number or new_number())
            return self._tenure

    def renew(self, caller: Caller, seconds: Any, number: Any) -> Tenure:
        """Extend a lease.

        Args:
            caller: Holder of the lease.
            seconds: New remaining time of the lease [s].
            number: Number of the lease, from `take`.

        Raises:
            LeaseLost: The lease expired or was released, or the HAL was restarted.
            CommandHeld: Another client has taken the lease since.
            BadArguments: The time is not allowed.
        """
        duration = _checked(seconds)
        with self._lock:
            tenure = self.tenure
            if tenure is not None and tenure.caller.boot != caller.boot:
                raise self._refusal(tenure)
            if tenure is None or tenure.number != number:
                raise LeaseLost("This lease has ended: it was not renewed in time, or the HAL was restarted.")
            self._tenure = replace(tenure, until=self._clock.monotonic() + duration)
            return self._tenure

    def give_back(self, caller: Caller, number: Any) -> None:
        """End the caller's lease of this number; a service that commanded for the caller must then stop.

        Raises:
            CommandHeld: Another client has the lease, or this one under another number.
        """
        with self._lock:
            tenure = self.tenure
            if tenure is None:
                return
            if tenure.caller.boot != caller.boot or not tenure.number or (type(number), number) != (int, tenure.number):
                raise self._refusal(tenure)
            self._tenure = replace(tenure, until=-math.inf)

    def check(self, caller: Caller) -> None:
        """Raise `CommandHeld` if another client commands; a caller without a boot is never the holder."""
        tenure = self.tenure
        if tenure is None or (caller.boot and caller.boot in (tenure.caller.boot, tenure.through)):
            return
        if caller.through and caller.through == tenure.caller.boot:
            return  # a service that streams without a lease commands for any client
        raise self._refusal(tenure)

    def delegate(self, caller: Caller) -> None:
        """Let the service that queries for the caller also command for the caller, until the caller's lease ends.

        Raises:
            CommandHeld: Another client commands.
        """
        with self._lock:
            self.check(caller)
            tenure = self.tenure
            if tenure is None:
                self._tenure, self._shared = Tenure(), caller.through
            elif tenure.caller.boot == caller.boot:
                self._tenure = replace(tenure, through=caller.through)

    def stream(self, caller: Caller) -> None:
        """Make the caller of an accepted command the holder for `STREAM` seconds, if no client has a lease.

        Never waits: while another thread uses the lease, the call has no effect, and the next command repeats it.
        """
        if not self._lock.acquire(blocking=False):
            return
        try:
            tenure = self.tenure
            if tenure is None or (tenure.caller.boot == caller.boot and not tenure.number):
                self._tenure = Tenure(caller, self._clock.monotonic() + STREAM)
        finally:
            self._lock.release()

    def check_stream(self, caller: Caller) -> None:
        """Check that this caller may command.

        Raises:
            CommandHeld: Another client commands, or the caller has no boot.
            LeaseLost: The caller commanded for a client whose lease has ended.
        """
        if not caller.boot:
            raise CommandHeld("A command without its sender's `boot` was refused.")
        tenure = self._tenure
        if tenure.through == caller.boot and self.tenure is None:
            raise LeaseLost(f"The lease of {tenure.caller} has ended, so commands sent for this client are refused.")
        self.check(caller)

    def end_stream(self) -> None:
        """End the tenure of a client without a lease, because the robot takes no commands now."""
        tenure = self._tenure
        if tenure.number or tenure.until == -math.inf or not self._lock.acquire(blocking=False):
            return
        try:
            if not self._tenure.number:
                self._tenure = replace(self._tenure, until=-math.inf)
        finally:
            self._lock.release()

    def _refusal(self, tenure: Tenure) -> CommandHeld:
        left = max(0.0, tenure.until - self._clock.monotonic())
        return CommandHeld(
            f"{tenure.caller} commands this robot for another {left:.1f} s, and longer if it continues. "
            "Stopping is always allowed."
        )


def new_number() -> int:
    """Return a random number for a lease."""
    return secrets.randbits(53) or 1


def _checked(seconds: Any) -> float:
    is_number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
    if not is_number or not SHORTEST <= seconds <= LONGEST:  # also refuses NaN
        raise BadArguments(
            f"A lease has a length of {SHORTEST:g} to {LONGEST:g} s, not {shown(seconds)}; renew it to keep it longer."
        )
    return float(seconds)
