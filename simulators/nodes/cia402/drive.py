"""A simulated CiA 402 servo drive: state machine, limits and faults; how it moves is `DriveMechanics`."""

from typing_extensions import override

from simulators.nodes.canopen.node import GENERIC, HARDWARE, HEARTBEAT_LOST, CanopenNode
from simulators.nodes.canopen.objects import Abort, Refused, Value
from simulators.nodes.canopen.spec import DriveConstants, NodeSpec
from simulators.nodes.cia402.mechanics import INTERPOLATE, DriveMechanics
from simulators.nodes.cia402.motion import (
    CYCLIC_POSITION,
    CYCLIC_TORQUE,
    CYCLIC_VELOCITY,
    HOMING,
    INTERPOLATED_POSITION,
    PROFILE_POSITION,
)
from simulators.nodes.cia402.states import State, following
from simulators.nodes.node import Frame
from simulators.nodes.plant import Plant

_VOLTAGE, _REMOTE, _REACHED, _LIMIT, _SPECIFIC, _DEVIATES = 1 << 4, 1 << 9, 1 << 10, 1 << 11, 1 << 12, 1 << 13
"""These are bits of the status word beside the state; 12 and 13 differ by mode."""

_FOLLOWING_ERROR = 0x8611
_NO_WINDOW = 2**32 - 1
_STOP_TIME = 0.5
"""A quick stop takes at most this long [s]; then the brake closes."""
_STANDSTILL = 0.02
"""The drive counts as standing below this speed of the spool or joint [turns/s]."""
_CYCLIC = (CYCLIC_POSITION, CYCLIC_VELOCITY, CYCLIC_TORQUE)


class ServoDrive(CanopenNode):
    """A drive whose position the world's servo follows; without operation enabled the servo's brake holds."""

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, DriveConstants)
        self._constants = spec.constants
        self.state = State.SWITCH_ON_DISABLED
        self._controlword = 0
        self._words: list[tuple[int, int]] = []
        """Control words that have come since `follow`, each with the one before it."""
        self._sampled = -1.0
        """Time [s] of what the object dictionary has as measured."""
        self._stop_ends = 0.0
        self._after_stop = State.SWITCH_ON_DISABLED
        self._deviates_since: float | None = None
        super().__init__(spec, plant, outbox)
        self.objects.power_on |= {
            (0x608F, 1): self._constants.counts_per_turn,
            (0x6091, 1): round(self._constants.gear),
            (0x6076, 0): round(self._constants.rated_torque * 1e3),
            (0x60A9, 0): self._constants.velocity_unit,
        }
        sheets_own = self.objects.entries[0x6502, 0]
        if spec.sheet is None or not sheets_own.is_stated:  # a maker's file knows the modes of its drive
            self.objects.power_on[0x6502, 0] = sum(1 << mode - 1 for mode in self._constants.modes)
        self._mechanics = DriveMechanics(self._constants, spec.element, plant, self.objects.values)
        self.objects.on_write[0x6060] = self._check_mode
        self.objects.on_write[0x605A] = self._check_quick_stop
        self.objects.after_write[0x6040] = lambda sub: self._obey()

    @property
    def servo(self) -> tuple[float, bool]:
        """Target of the world's servo [m or rad], and whether it is enabled."""
        enabled = self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
        return self._mechanics.target, enabled

    @override
    def restart(self) -> None:
        self.state = State.SWITCH_ON_DISABLED
        self._controlword = 0
        self._deviates_since = None
        if self.is_powered:
            self._mechanics.restart()

    def sample(self) -> None:
        """Measure position, velocity, torque, temperature and status from the newest measurement."""
        values = self.objects.values
        self._mechanics.measure(
            self._now, is_free=self.state is not State.OPERATION_ENABLED and not self._is_stopping()
        )
        values[0x6061, 0] = values[0x6060, 0]
        values[0x6041, 0] = self._statusword()
        self._sampled = self._now

    def follow(self, now: float) -> None:
        """Take the newest set-point, and carry on a stop."""
        if self.state is State.OPERATION_ENABLED:
            if now != self._sampled:
                self.sample()
            mode = int(self.objects.values[0x6060, 0])
            for word, before in self._words:
                self._mechanics.command(mode, word, before)
            self._mechanics.move(now, mode, self._controlword)
            self._watch_deviation(now)
        self._words.clear()
        if self._is_stopping():
            self.sample()
            slow = self._constants.counts_per_turn * self._constants.gear * _STANDSTILL
            if now >= self._stop_ends or abs(self._mechanics.velocity) < slow:
                self.state = self._after_stop

    def connection_lost(self, code: int) -> None:
        """Act as the abort connection option code (6007h) says; only a drive under power has anything to stop."""
        option = self.objects.values[0x6007, 0]
        if option == 0 or self.state not in (State.SWITCHED_ON, State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE):
            return
        if option == 2:
            self.state = State.SWITCH_ON_DISABLED
        elif option == 3 and self.state is State.OPERATION_ENABLED:
            self._stop(State.QUICK_STOP_ACTIVE, State.FAULT if code else State.SWITCH_ON_DISABLED)
            self.objects.values[0x603F, 0] = code
        else:
            self._react(code or HEARTBEAT_LOST)

    @override
    def break_down(self) -> None:
        self.emergency(HARDWARE, GENERIC)
        self._react(HARDWARE)

    def _obey(self) -> None:
        word = int(self.objects.values[0x6040, 0])
        before, self._controlword = self._controlword, word
        state = following(self.state, word, before)
        if state is self.state:
            if state is State.OPERATION_ENABLED:  # acted on in `follow`: a target may stand behind it in the same PDO
                self._words.append((word, before))
            return
        if self.state is State.FAULT:
            self.objects.values[0x603F, 0] = 0
            self.clear_errors()
        if state is State.QUICK_STOP_ACTIVE:
            option = self.objects.values[0x605A, 0]
            after = State.QUICK_STOP_ACTIVE if option in (5, 6) else State.SWITCH_ON_DISABLED
            if option:
                self._stop(State.QUICK_STOP_ACTIVE, after)
                return
            state = State.SWITCH_ON_DISABLED
        elif self.state is State.QUICK_STOP_ACTIVE and self._after_stop is not self.state:
            return  # on its way to SWITCH ON DISABLED or FAULT already
        if state is State.OPERATION_ENABLED:
            self.sample()
            self._mechanics.start(self._now)
        self.state = state

    def _watch_deviation(self, now: float) -> None:
        """Enter a fault when demand and position are further apart than 6065h for longer than 6066h."""
        values = self.objects.values
        window = int(values[0x6065, 0])
        if window == _NO_WINDOW or abs(int(values[0x60F4, 0])) <= window:
            self._deviates_since = None
        elif self._deviates_since is None:
            self._deviates_since = now
        elif now - self._deviates_since >= int(values[0x6066, 0]) * 1e-3:
            self._deviates_since = None
            self.emergency(_FOLLOWING_ERROR, GENERIC)
            self._react(_FOLLOWING_ERROR)

    def _react(self, code: int) -> None:
        """Handle a fault: stop by the fault reaction option code (605Eh), then FAULT."""
        self.objects.values[0x603F, 0] = code
        if self.state is State.OPERATION_ENABLED and self.objects.values[0x605E, 0]:
            self._stop(State.FAULT_REACTION_ACTIVE, State.FAULT)
        else:
            self.state = State.FAULT

    def _stop(self, during: State, after: State) -> None:
        """Stop at the quick stop deceleration (6085h)."""
        self.sample()
        self._mechanics.brake()
        self._stop_ends = self._now + _STOP_TIME
        self._after_stop = after
        self.state = during

    def _is_stopping(self) -> bool:
        return self.state in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)

    def _statusword(self) -> int:
        mechanics, mode = self._mechanics, self.objects.values[0x6060, 0]
        word = self.state | _VOLTAGE | _REMOTE
        if mechanics.is_limited:
            word |= _LIMIT
        if mode == HOMING:
            word |= _SPECIFIC * mechanics.homing.is_attained | _DEVIATES * mechanics.homing.is_wrong
            word |= _REACHED * (not mechanics.homing.is_busy)
        elif mode == PROFILE_POSITION:
            word |= _SPECIFIC * mechanics.set_points.is_acknowledged | _REACHED * mechanics.is_reached
            word |= _DEVIATES * (self._deviates_since is not None)
        elif mode == INTERPOLATED_POSITION and self.state is State.OPERATION_ENABLED:
            word |= _SPECIFIC * bool(self._controlword & INTERPOLATE) | _DEVIATES * (self._deviates_since is not None)
        elif mode in _CYCLIC and self.state is State.OPERATION_ENABLED:
            word |= _SPECIFIC | _DEVIATES * (self._deviates_since is not None)
        return word

    def _check_mode(self, sub: int, old: Value, new: Value) -> None:
        mode = int(new)
        has_mode = mode == 0 or (mode > 0 and int(self.objects.values[0x6502, 0]) >> mode - 1 & 1)
        if not has_mode:
            raise Refused(Abort.VALUE)
        if new != old and self.state is State.OPERATION_ENABLED:
            self.sample()
            self._mechanics.start(self._now)

    def _check_quick_stop(self, sub: int, old: Value, new: Value) -> None:
        if new not in (0, 1, 2, 5, 6):
            raise Refused(Abort.VALUE)
