"""Who may direct the model: whoever commands the robot, and anybody while nobody does; as the HAL tells."""

from collections.abc import Callable
from dataclasses import replace

from hal.clock import Clock
from services.errors import CommandHeld
from services.model.estimation import Fresh
from services.wire.caller import Caller
from services.wire.messages import Holder, Target
from services.wire.recent import age_of, refuse_late
from services.wire.streams import Newest

HEARD_WITHIN = 2.5
"""How long [s] is believed what the HAL, which tells it every second, has told of who commands."""


class Directing:
    """What the model service knows of who commands.

    Args:
        boot: Of the model service.
        newest: Returns the last sample of the HAL, however old.
        holder: What the HAL tells.
        rate: Of the HAL's cycle [Hz].
        clock: Of this process.
    """

    def __init__(
        self, boot: int, newest: Callable[[], Fresh | None], holder: Newest[Holder], rate: float, clock: Clock
    ) -> None:
        self._boot, self._newest, self._holder, self._rate, self._clock = boot, newest, holder, rate, clock
        self._was_through = False
        self.engaged_by = Caller()
        """Who asked to engage last."""

    def check(self, caller: Caller) -> None:
        """Raise `CommandHeld` if somebody else commands; the model itself does for whoever asks it first."""
        held = self._held()
        if held is None or held.holder == self._boot or (caller.boot and caller.boot == held.holder):
            return
        raise CommandHeld(f"{held.name} commands this robot. Stopping is always allowed.")

    def may_move(self, caller: Caller) -> None:
        """Raise `CommandHeld` as `check`, and `TooLate` if the question was asked too long ago."""
        self.check(caller)
        fresh, age = self._newest(), float("inf")
        if fresh is not None:
            waited = self._clock.monotonic() - fresh.received
            age = age_of(caller.cycle, caller.hal_boot, fresh.sample, waited, self._rate)
        refuse_late(caller, 0 if fresh is None else fresh.sample.boot, age)

    def may_set(self, target: Target) -> None:
        """As `may_move`, for a target that was published."""
        self.may_move(Caller("", target.boot, 0, target.hal_boot, target.cycle))

    def begin(self, caller: Caller) -> None:
        """The controller is engaged for a caller."""
        self.engaged_by, self._was_through = caller, False

    def on_behalf(self, caller: Caller) -> Caller:
        """The caller, as the model service asks the HAL for it: with the newest sample that the model has."""
        fresh = self._newest()
        seen = (0, 0) if fresh is None else (fresh.sample.boot, fresh.sample.cycle)
        return replace(caller, through=self._boot, hal_boot=seen[0], cycle=seen[1])

    @property
    def name(self) -> str:
        """Under which the model commands."""
        return f"model service, engaged by {self.engaged_by}"

    def ended(self) -> str:
        """Why an engaged controller must let go, in a sentence; empty while it need not."""
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
        waited, held = self._clock.monotonic() - last[0], last[1]
        return held if held.holder and waited <= HEARD_WITHIN and waited < held.left else None
