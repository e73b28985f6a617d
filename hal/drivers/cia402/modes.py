"""State machines that a drive steps in every cycle: the handshake of profile position, and homing."""

from enum import StrEnum

from hal.protocols import cia402
from hal.protocols.cia402 import OperationMode, State

IGNORED = 5
"""In this number of cycles after the start of homing its status bits may still be old."""


class SetPointHandshake:
    """The handshake of profile position: the drive takes a set-point on the rising edge of bit 4 and answers by bit 12.

    During a handshake newer set-points wait, and only the newest one is sent next.
    """

    def __init__(self) -> None:
        self._sent = 0
        self._is_up = False
        self.waited = 0
        """Cycles since the newest set-point without an answer."""

    def start(self, position: int) -> None:
        """Start at the drive's position [counts], which needs no set-point."""
        self._sent, self._is_up, self.waited = position, False, 0

    def step(self, target: int, statusword: int) -> tuple[int, int]:
        """Return bits of the controlword and the target position [counts] of this cycle."""
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
    MODE = "entering the homing mode"
    ENABLE = "being enabled for homing"
    SEARCH = "searching for its zero"
    LEAVE = "leaving the homing mode"


class HomingRun:
    """One homing run, which begins and ends with a drive without power."""

    def __init__(self, own_mode: OperationMode, longest: int) -> None:
        """Begin.

        Args:
            own_mode: Mode of the drive after homing.
            longest: Homing fails after this number of cycles.
        """
        self._own_mode = own_mode
        self._longest = longest
        self._cycles = 0
        self._search_start = 0
        self._phase = _Phase.MODE
        self.problem = ""
        """Reason why homing failed; empty if it did not."""
        self.is_over = False

    @property
    def phase(self) -> str:
        """Present phase in words."""
        return self._phase.value

    def give_up(self, reason: str) -> None:
        """End the run with a reason, and disable the drive."""
        if self._phase is not _Phase.LEAVE:
            self.problem, self._phase = reason, _Phase.LEAVE

    def step(self, state: State, statusword: int, mode: int) -> tuple[int, OperationMode]:
        """Return controlword and mode of operation of this cycle.

        Args:
            state: State of the drive.
            statusword: Its statusword.
            mode: Its present mode (6061h).
        """
        self._cycles += 1
        if self._cycles > self._longest:
            self.give_up(f"took longer than allowed while {self.phase}")
        if self._phase is _Phase.MODE and mode == OperationMode.HOMING:
            self._phase = _Phase.ENABLE
        if self._phase is _Phase.ENABLE:
            if state is not State.OPERATION_ENABLED:
                return cia402.towards_enabled(state), OperationMode.HOMING
            self._phase, self._search_start = _Phase.SEARCH, self._cycles
            return cia402.ENABLE_OPERATION, OperationMode.HOMING
        if self._phase is _Phase.SEARCH:
            self._check_search(state, statusword)
        if self._phase is _Phase.SEARCH:
            return cia402.ENABLE_OPERATION | cia402.START_HOMING, OperationMode.HOMING
        if self._phase is _Phase.LEAVE:
            is_off = state not in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
            self.is_over = is_off and (mode == self._own_mode or self._cycles > 2 * self._longest)
            return cia402.towards_disabled(state), self._own_mode if is_off else OperationMode.HOMING
        return cia402.towards_disabled(state), OperationMode.HOMING

    def _check_search(self, state: State, statusword: int) -> None:
        if state is not State.OPERATION_ENABLED:
            self.give_up(f"ended because the drive became '{state}'")
        elif self._cycles - self._search_start > IGNORED:
            if statusword & cia402.HOMING_ERROR:
                self.give_up("failed: the drive reports a homing error. Are method, switches and limits right?")
            elif statusword & cia402.HOMING_ATTAINED and statusword & cia402.TARGET_REACHED:
                self._phase = _Phase.LEAVE
