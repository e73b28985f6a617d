"""A simulated CiA 402 servo drive in cyclic synchronous position mode."""

import math

from simulators.nodes.canopen_node import GENERIC, HARDWARE, HEARTBEAT_LOST, CanopenNode
from simulators.nodes.drive_states import State, following
from simulators.nodes.node import Frame
from simulators.nodes.objects import Abort, Refused, Value
from simulators.nodes.plant import Plant
from simulators.nodes.spec import DriveConstants, NodeSpec

CYCLIC_POSITION = 8
_MODES = (0, CYCLIC_POSITION)
_INT16, _INT32 = 2**15, 2**31

_VOLTAGE, _REMOTE, _LIMIT, _FOLLOWS = 1 << 4, 1 << 9, 1 << 11, 1 << 12
"""Bits of the status word beside the state."""

_STOP_TIME = 0.5
"""Longest quick stop [s]; then the brake takes the rest."""
_STANDSTILL = 0.02
"""Turns of the spool or joint per second below which the drive counts as standing."""


class ServoDrive(CanopenNode):
    """A drive whose position the world's servo follows; without operation enabled the servo's brake holds."""

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, DriveConstants)
        self._constants = spec.constants
        self.state = State.SWITCH_ON_DISABLED
        self._controlword = 0
        self._demand = 0
        self._velocity = 0.0
        self._before: tuple[float, int] | None = None
        self._stop_ends = 0.0
        self._after_stop = State.SWITCH_ON_DISABLED
        super().__init__(spec, plant, outbox)
        self.objects.power_on |= {
            (0x608F, 1): self._constants.counts_per_turn,
            (0x6091, 1): round(self._constants.gear),
            (0x6076, 0): round(self._constants.rated_torque * 1e3),
        }
        self.objects.on_write[0x6060] = self._check_mode
        self.objects.on_write[0x605A] = self._check_quick_stop
        self.objects.after_write[0x6040] = lambda sub: self._obey()

    @property
    def servo(self) -> tuple[float, bool]:
        """What the world's servo is to do: target [m or rad], and whether it is enabled at all."""
        enabled = self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
        return self._constants.zero + self._demand / self._constants.counts_per_unit, enabled

    def restart(self) -> None:
        """See `CanopenNode.restart`."""
        self.state = State.SWITCH_ON_DISABLED
        self._controlword = 0
        self._before = None
        self._velocity = 0.0

    def sample(self) -> None:
        """Position, velocity, torque and status from the newest measurement."""
        values = self.objects.values
        constants = self._constants
        length = self.plant.read(self.spec.element)
        position = _clip((length - constants.zero) * constants.counts_per_unit, _INT32)
        self._differentiate(position)
        torque = self._torque()
        values[0x6064, 0] = position
        values[0x606C, 0] = _clip(self._velocity, _INT32)
        values[0x6077, 0] = torque
        if self.state is not State.OPERATION_ENABLED and not self._is_stopping():
            self._demand = position
        values[0x6062, 0] = self._demand
        values[0x6061, 0] = values[0x6060, 0]
        values[0x6041, 0] = self._statusword(abs(torque) >= int(values[0x6072, 0]))

    def follow(self, now: float) -> None:
        """Take the newest set-point, and carry on a stop."""
        if self.state is State.OPERATION_ENABLED:
            if self.objects.values[0x6060, 0] == CYCLIC_POSITION:
                self._demand = self._limited(int(self.objects.values[0x607A, 0]))
        elif self._is_stopping():
            self.sample()
            slow = self._constants.counts_per_turn * self._constants.gear * _STANDSTILL
            if now >= self._stop_ends or abs(self._velocity) < slow:
                self._stopped()

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

    def break_down(self) -> None:
        """See `CanopenNode.break_down`."""
        self.emergency(HARDWARE, GENERIC)
        self._react(HARDWARE)

    def _obey(self) -> None:
        word = int(self.objects.values[0x6040, 0])
        before, self._controlword = self._controlword, word
        state = following(self.state, word, before)
        if state is self.state:
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
        self.state = state

    def _react(self, code: int) -> None:
        """Fault: stop by the fault reaction option code (605Eh), then FAULT."""
        self.objects.values[0x603F, 0] = code
        if self.state is State.OPERATION_ENABLED and self.objects.values[0x605E, 0]:
            self._stop(State.FAULT_REACTION_ACTIVE, State.FAULT)
        else:
            self.state = State.FAULT

    def _stop(self, during: State, after: State) -> None:
        """Come to rest at the quick stop deceleration (6085h) from the speed now."""
        self.sample()
        deceleration = int(self.objects.values[0x6085, 0])
        way = self._velocity * abs(self._velocity) / (2.0 * deceleration)
        self._demand = self._limited(_clip(int(self.objects.values[0x6064, 0]) + way, _INT32))
        self._stop_ends = self._now + _STOP_TIME
        self._after_stop = after
        self.state = during

    def _is_stopping(self) -> bool:
        return self.state in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)

    def _stopped(self) -> None:
        self.state = self._after_stop

    def _differentiate(self, position: int) -> None:
        time = self.plant.time
        if self._before is None:
            self._before = (time, position)
        elif time > self._before[0]:
            self._velocity = (position - self._before[1]) / (time - self._before[0])
            self._before = (time, position)

    def _torque(self) -> int:
        """Motor torque in thousandths of the rated one; a taut wire pulls towards growing length."""
        constants = self._constants
        if constants.load is None:
            return 0
        load = self.plant.read(constants.load)
        arm = -constants.spool_radius if constants.spool_radius else 1.0
        share = constants.direction * load * arm / constants.gear / constants.rated_torque
        return _clip(share * 1e3, _INT16)

    def _limited(self, target: int) -> int:
        """A set-point within 607Dh, and not further into a load that already takes the largest torque (6072h)."""
        values = self.objects.values
        target = min(max(target, int(values[0x607D, 1])), int(values[0x607D, 2]))
        torque, position = int(values[0x6077, 0]), int(values[0x6064, 0])
        if abs(torque) >= int(values[0x6072, 0]) and (target - position) * torque > 0:
            return position
        return target

    def _statusword(self, is_limited: bool) -> int:
        word = self.state | _VOLTAGE | _REMOTE
        if is_limited:
            word |= _LIMIT
        if self.state is State.OPERATION_ENABLED and self.objects.values[0x6060, 0] == CYCLIC_POSITION:
            word |= _FOLLOWS
        return word

    def _check_mode(self, sub: int, old: Value, new: Value) -> None:
        if new not in _MODES:
            raise Refused(Abort.VALUE)

    def _check_quick_stop(self, sub: int, old: Value, new: Value) -> None:
        if new not in (0, 1, 2, 5, 6):
            raise Refused(Abort.VALUE)


def _clip(value: float, bound: int) -> int:
    """The nearest integer that fits; 0 for what is no number."""
    if math.isnan(value):
        return 0
    return round(min(max(value, -bound), bound - 1))
