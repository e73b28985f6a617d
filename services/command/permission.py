"""Permission for a client to use the model service to move the robot, from the lease holder that the HAL publishes."""

from collections.abc import Callable
from dataclasses import replace

from hal.clock import Clock
from services.command.lateness import age_of, refuse_late
from services.errors import CommandHeld
from services.wire.caller import Caller
from services.wire.messages import Holder, Sample, Target
from services.wire.streams import Arrival, Reader

HEARD_WITHIN = 2.5
"""A `Holder` message is valid for this long [s]; the HAL publishes one per second."""


class Permission:
    """Check of the clients that direct the model service: only the lease holder may, or any client without a holder.

    Args:
        boot: `boot` of the model service.
        newest: Function that returns the last sample of the HAL, of any age.
        holder: Reader of the HAL's `Holder` messages.
        rate: Rate of the HAL's cycle [Hz].
        clock: Clock of this process.

    Attributes:
        engaged_by: The last caller that engaged the controller.
    """

    def __init__(
        self,
        boot: int,
        newest: Callable[[], Arrival[Sample] | None],
        holder: Reader[Holder],
        rate: float,
        clock: Clock,
    ) -> None:
        self._boot, self._newest, self._holders, self._rate, self._clock = boot, newest, holder, rate, clock
        self._was_through = False
        self.engaged_by = Caller()

    def check(self, caller: Caller) -> None:
        """Raise `CommandHeld` if another client commands; if the model service commands, any client may direct it."""
        holder = self._valid_holder()
        if holder is None or holder.holder == self._boot or (caller.boot and caller.boot == holder.holder):
            return
        raise CommandHeld(f"{holder.name} commands this robot. Stopping is always allowed.")

    def may_move(self, caller: Caller) -> None:
        """Raise `CommandHeld` as `check` does, and `TooLate` if the request is too old."""
        self.check(caller)
        newest, age = self._newest(), float("inf")
        if newest is not None:
            waited = self._clock.monotonic() - newest.received
            age = age_of(caller.cycle, caller.hal_boot, newest.message, waited, self._rate)
        refuse_late(caller, 0 if newest is None else newest.message.boot, age)

    def may_set(self, target: Target) -> None:
        """Raise as `may_move` does, for the sender of a published target."""
        self.may_move(Caller("", target.boot, 0, target.hal_boot, target.cycle))

    def begin(self, caller: Caller) -> None:
        """Store the caller that engaged the controller."""
        self.engaged_by, self._was_through = caller, False

    def on_behalf(self, caller: Caller) -> Caller:
        """Return the caller for a query to the HAL: marked as sent by the model service, with its newest sample."""
        newest = self._newest()
        boot, cycle = (0, 0) if newest is None else (newest.message.boot, newest.message.cycle)
        return replace(caller, through=self._boot, hal_boot=boot, cycle=cycle)

    @property
    def name(self) -> str:
        """Name under which the model commands."""
        return f"model service, engaged by {self.engaged_by}"

    def ended(self) -> str:
        """Return the reason to disengage the controller, as one sentence; empty if there is no reason."""
        holder = self._valid_holder()
        through = 0 if holder is None else holder.through
        if through == self._boot:
            self._was_through = True
        elif holder is not None and holder.holder not in (self._boot, self.engaged_by.boot):
            return f"{holder.name} commands the robot now, so the controller was disengaged."
        elif self._was_through:
            return f"The lease of {self.engaged_by} has ended, so the controller was disengaged."
        return ""

    def _valid_holder(self) -> Holder | None:
        last = self._holders.last()
        if last is None:
            return None
        age, holder = self._clock.monotonic() - last.received, last.message
        return holder if holder.holder and age <= HEARD_WITHIN and age < holder.left else None
