"""The model service's permission to move the robot, by what the HAL publishes about who commands."""

from collections.abc import Callable
from dataclasses import replace

from hal.clock import Clock
from services.command.lateness import age_of, refuse_late
from services.errors import CommandHeld
from services.wire.caller import Caller
from services.wire.messages import Holder, Sample, Target
from services.wire.streams import Arrival, Reader

HEARD_WITHIN = 2.5
"""A `Holder` message is believed for this long [s]; the HAL publishes one a second."""


class Permission:
    """The model service's rules for who may direct it: the lease holder, and any client while the robot has none.

    Args:
        boot: `boot` of the model service.
        newest: Returns the last sample of the HAL, however old.
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
        self._boot, self._newest, self._holder, self._rate, self._clock = boot, newest, holder, rate, clock
        self._was_through = False
        self.engaged_by = Caller()

    def check(self, caller: Caller) -> None:
        """Raise `CommandHeld` if another client commands; while the model itself does, any client may direct it."""
        held = self._held()
        if held is None or held.holder == self._boot or (caller.boot and caller.boot == held.holder):
            return
        raise CommandHeld(f"{held.name} commands this robot. Stopping is always allowed.")

    def may_move(self, caller: Caller) -> None:
        """Raise `CommandHeld` as `check` does, and `TooLate` if the question was asked too long ago."""
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
        """Note that the controller is engaged for a caller."""
        self.engaged_by, self._was_through = caller, False

    def on_behalf(self, caller: Caller) -> Caller:
        """Return the caller as the model service sends it to the HAL: with the newest sample that the model has."""
        newest = self._newest()
        boot, cycle = (0, 0) if newest is None else (newest.message.boot, newest.message.cycle)
        return replace(caller, through=self._boot, hal_boot=boot, cycle=cycle)

    @property
    def name(self) -> str:
        """Name under which the model commands."""
        return f"model service, engaged by {self.engaged_by}"

    def ended(self) -> str:
        """Return in one sentence why an engaged controller must let go; empty while it need not."""
        held = self._held()
        through = 0 if held is None else held.through
        if through == self._boot:
            self._was_through = True
        elif held is not None and held.holder != self._boot and held.holder != self.engaged_by.boot:
            return f"{held.name} commands the robot now, so the controller let go."
        elif self._was_through:
            return f"The lease of {self.engaged_by} has ended, so the controller let go."
        return ""

    def _held(self) -> Holder | None:
        last = self._holder.last()
        if last is None:
            return None
        waited, held = self._clock.monotonic() - last.received, last.message
        return held if held.holder and waited <= HEARD_WITHIN and waited < held.left else None
