"""Who commands a robot: one holder at a time, for as long as it says so again and again.

It keeps clients out of each other's way; it keeps nobody out who lies about who it is. That is what roles are for.
"""

import math
import secrets
import threading
from dataclasses import dataclass, replace
from typing import Any

from hal.clock import Clock, SystemClock
from services.errors import BadArguments, CommandHeld, LeaseLost
from services.wire.caller import NOBODY, Caller
from services.wire.plain_text import shown

LONGEST = 60.0
"""Longest lease [s]: who vanishes must not keep others out for long."""
SHORTEST = 0.2
"""Shortest lease [s]: it is to be renewed in time on a busy machine."""
STREAM = 1.0
"""How long [s] after its last command a client that took no lease still commands."""


@dataclass(frozen=True, slots=True)
class Held:
    """A lease, or what is left of one.

    Attributes:
        caller: Who commands; a caller without a boot if nobody ever did.
        until: When it ends [monotonic s].
        through: `boot` of the service that commands for the caller; 0 if the caller does so itself.
        number: Tells this lease from every other one; 0 if a stream of commands took it.
    """

    caller: Caller = NOBODY
    until: float = -math.inf
    through: int = 0
    number: int = 0


class Lease:
    """The one lease of a robot; any thread may use it, and nobody waits who only looks or streams commands."""

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or SystemClock()
        self._lock = threading.Lock()
        self._held = Held()

    @property
    def held(self) -> Held | None:
        """The lease that runs; None if nobody commands."""
        held = self._held
        return held if held.caller.boot and self._clock.monotonic() < held.until else None

    def left(self) -> float:
        """How long [s] the lease still runs; 0 if none does."""
        return max(0.0, self._held.until - self._clock.monotonic())

    def take(self, caller: Caller, seconds: Any) -> Held:
        """Take the lease for so many seconds; whoever holds it has it for so many from now.

        Raises:
            CommandHeld: Somebody else has it.
            BadArguments: Not such a time, or a caller without a boot.
        """
        duration = _checked(seconds)
        if not caller.boot:
            raise BadArguments(
                "Who wants to command must tell a `boot`, a random number of its own, beside the question."
            )
        with self._lock:
            held = self.held
            if held is None:
                self._held = Held(caller, self._clock.monotonic() + duration, 0, _new_number())
            elif held.caller.boot == caller.boot:
                until = self._clock.monotonic() + duration
                self._held = Held(caller, until, held.through, held.number or _new_number())
            else:
                raise self._refusal(held)
            return self._held

    def renew(self, caller: Caller, seconds: Any, number: Any) -> Held:
        """Go on with a lease that was taken before.

        Args:
            caller: Its holder.
            seconds: How long it shall run from now [s].
            number: Of the lease, as `take` told it.

        Raises:
            LeaseLost: It ran out or was given back, perhaps by a HAL that was restarted since.
            CommandHeld: Somebody else has taken it since.
            BadArguments: Not such a time.
        """
        duration = _checked(seconds)
        with self._lock:
            held = self.held
            if held is not None and held.caller.boot != caller.boot:
                raise self._refusal(held)
            if held is None or held.number != number:
                raise LeaseLost("This lease has ended: it was not renewed in time, or the HAL was restarted.")
            self._held = replace(held, until=self._clock.monotonic() + duration)
            return self._held

    def give_back(self, caller: Caller) -> None:
        """End the lease if it is this caller's; the service through which it commanded may not go on by itself."""
        with self._lock:
            if caller.boot and self._held.caller.boot == caller.boot:
                self._held = replace(self._held, until=-math.inf)

    def check(self, caller: Caller) -> None:
        """Raise `CommandHeld` if somebody else commands; a caller without a boot is always somebody else."""
        held = self.held
        if held is None or (caller.boot and caller.boot in (held.caller.boot, held.through)):
            return
        if caller.through and caller.through == held.caller.boot:
            return  # nobody took a lease: the service commands for whoever asks it
        raise self._refusal(held)

    def delegate(self, caller: Caller) -> None:
        """Let the service that asks on the caller's behalf command for it, as long as the caller's lease runs.

        Raises:
            CommandHeld: Somebody else commands.
        """
        with self._lock:
            self.check(caller)
            held = self.held
            if held is None:
                self._held = Held()
            elif held.caller.boot == caller.boot:
                self._held = replace(held, through=caller.through)

    def stream(self, caller: Caller) -> None:
        """A command of this caller was followed: without a lease, that is one for `STREAM` seconds.

        Waits for nobody: who comes at the same time as another one is late by a command.
        """
        if not self._lock.acquire(blocking=False):
            return
        try:
            held = self.held
            if held is None or (held.caller.boot == caller.boot and not held.number):
                self._held = Held(caller, self._clock.monotonic() + STREAM)
        finally:
            self._lock.release()

    def check_stream(self, caller: Caller) -> None:
        """Raise if a command of this caller must not be followed.

        Raises:
            CommandHeld: Somebody else commands, or the caller does not tell who it is.
            LeaseLost: It commanded for somebody whose lease has ended.
        """
        if not caller.boot:
            raise CommandHeld("A command was refused that does not tell its sender's `boot`.")
        held = self._held
        if held.through == caller.boot and self.held is None:
            raise LeaseLost(f"The lease of {held.caller} has ended, so what is sent on its behalf is not followed.")
        self.check(caller)

    def end_stream(self) -> None:
        """The robot takes no commands: who only streamed them commands no more."""
        held = self._held
        if held.number or held.until == -math.inf or not self._lock.acquire(blocking=False):
            return
        try:
            if not self._held.number:
                self._held = replace(self._held, until=-math.inf)
        finally:
            self._lock.release()

    def _refusal(self, held: Held) -> CommandHeld:
        left = max(0.0, held.until - self._clock.monotonic())
        return CommandHeld(
            f"{held.caller} commands this robot, for another {left:.1f} s unless it goes on. "
            "Stopping is always allowed."
        )


def _checked(seconds: Any) -> float:
    is_number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
    if not is_number or not SHORTEST <= seconds <= LONGEST:  # also refuses what is not a number
        raise BadArguments(
            f"A lease runs for {SHORTEST:g} to {LONGEST:g} s and is renewed by whoever needs it longer, "
            f"not for {shown(seconds)}."
        )
    return float(seconds)


def _new_number() -> int:
    return secrets.randbits(53) or 1
