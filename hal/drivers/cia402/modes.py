"""State machines that a servo drive's cycle steps: the handshake of profile position, and homing."""

from enum import StrEnum

from hal.protocols import cia402
from hal.protocols.cia402 import Mode, State

IGNORED = 5
"""So many cycles after homing was begun its bits may still be those of the time before."""


class SetPointHandshake:
    """Profile position: a new set-point is taken on the rising edge of bit 4, and bit 12 says that it was.

    While one is being handed over, newer ones wait; the newest is the next.
    """

    def __init__(self) -> None:
        self._sent = 0
        self._is_up = False
        self.waited = 0
        """Cycles that the drive has taken to answer."""

    def start(self, position: int) -> None:
        """The drive stands at `position` [counts], which needs no set-point."""
        self._sent, self._is_up, self.waited = position, False, 0

    def step(self, target: int, statusword: int) -> tuple[int, int]:
        """Bits for the controlword and the target position [counts] of this cycle."""
        is_taken = bool(statusword & cia402.SET_POINT_TAKEN)
        if self._is_up == is_taken:
            if self._is_up:
                self._is_up = False
            elif target != self._sent:
                self._sent, self._is_up = target, True
            self.waited = 0
        else:
            self.waited += 1
        return (cia402.NEW_SET_POINT | cia402.CHANGE_AT_ONCE if self._is_up else 0), self._sent


class _Phase(StrEnum):
    MODE = "taking the homing mode"
    ENABLE = "being enabled for homing"
    SEARCH = "searching for its zero"
    LEAVE = "leaving the homing mode"


class HomingRun:
    """One homing, from a drive without power back to a drive without power."""

    def __init__(self, own_mode: Mode, longest: int) -> None:
        """Begin.

        Args:
            own_mode: The mode to come back to.
            longest: Cycles after which it is given up.
        """
        self._own_mode = own_mode
        self._longest = longest
        self._cycles = 0
        self._begun = 0
        self._phase = _Phase.MODE
        self.problem = ""
        """Why the zero was not found; empty while it may be."""
        self.is_over = False

    @property
    def phase(self) -> str:
        """What the drive is doing, in words."""
        return self._phase.value

    def give_up(self, why: str) -> None:
        """Let the drive go and tell why."""
        if self._phase is not _Phase.LEAVE:
            self.problem, self._phase = why, _Phase.LEAVE

    def step(self, state: State, statusword: int, mode: int) -> tuple[int, Mode]:
        """Controlword and mode of operation of this cycle.

        Args:
            state: State of the drive.
            statusword: Its statusword.
            mode: The mode that it says it is in (6061h).
        """
        self._cycles += 1
        if self._cycles > self._longest:
            self.give_up(f"took longer than allowed while {self.phase}")
        if self._phase is _Phase.MODE and mode == Mode.HOMING:
            self._phase = _Phase.ENABLE
        if self._phase is _Phase.ENABLE:
            if state is not State.OPERATION_ENABLED:
                return cia402.towards_enabled(state), Mode.HOMING
            self._phase, self._begun = _Phase.SEARCH, self._cycles
            return cia402.ENABLE_OPERATION, Mode.HOMING
        if self._phase is _Phase.SEARCH:
            self._look(state, statusword)
        if self._phase is _Phase.SEARCH:
            return cia402.ENABLE_OPERATION | cia402.START_HOMING, Mode.HOMING
        if self._phase is _Phase.LEAVE:
            is_off = state not in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
            self.is_over = is_off and (mode == self._own_mode or self._cycles > 2 * self._longest)
            return cia402.towards_disabled(state), self._own_mode if is_off else Mode.HOMING
        return cia402.towards_disabled(state), Mode.HOMING

    def _look(self, state: State, statusword: int) -> None:
        if state is not State.OPERATION_ENABLED:
            self.give_up(f"ended because the drive became '{state}'")
        elif self._cycles - self._begun > IGNORED:
            if statusword & cia402.HOMING_ERROR:
                self.give_up("failed: the drive reports a homing error. Are method, switches and limits right?")
            elif statusword & cia402.HOMING_ATTAINED and statusword & cia402.TARGET_REACHED:
                self._phase = _Phase.LEAVE
