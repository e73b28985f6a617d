"""A simulated axis of an ODrive (CANSimple): its states, errors, watchdog and cascade, with a rotor of its own.

Written after the maker's documentation, with nothing of the driver's. What firmwares do differently is here in its
worst form: the last set-point is followed again when the loop is closed, and the watchdog runs out at rest too.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

from typing_extensions import override

from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.node import EXTENDED, REMOTE, Frame, Handler, SimulatedDrive, SimulatedNode
from simulators.nodes.plant import Plant
from simulators.nodes.rotor import Rotor

BROADCAST = 63
INITIALIZING, DRV_FAULT, WATCHDOG_TIMER_EXPIRED, ESTOP_REQUESTED = 0x1, 0x20, 0x100_0000, 0x200_0000
"""These are errors of the axis."""
SUCCESS, DISARMED = 0, 3
"""These are results of a request."""
TORQUE, VELOCITY, POSITION = 1, 2, 3
"""These are control modes."""

_BOOT_TIME = 0.2
"""The axis is idle this long after power-on [s]."""
_SUBSTEP = 5e-4
"""The rotor is advanced in steps of at most this [s]; the firmware closes its loops at 8 kHz."""
_LAG = 0.2
"""The rotor is at most this far [rad or m] from the world's position, so an obstacle blocks both."""


class AxisState(IntEnum):
    """States that are played."""

    UNDEFINED = 0
    IDLE = 1
    CLOSED_LOOP_CONTROL = 8


@dataclass(frozen=True, slots=True)
class OdriveConstants:
    """An axis. position [rad] = zero + direction * motor turns / gear * 2 pi.

    Attributes:
        gear: Motor turns per turn of the output.
        direction: +1 if the motor's turns grow with the position, else -1.
        zero: Position at zero turns [rad].
        inertia: Inertia at the output [kg m2].
        friction: Friction at the output [N m s/rad].
        load: `signal.element` of the effort [N m] that pulls towards growing position; None: no load.
        position_gain: Gain of the position loop [1/s].
        velocity_gain: Gain of the velocity loop [N m s per motor turn].
        integrator_gain: Integrator gain [N m per motor turn].
        velocity_limit: Limit of the velocity [motor turns/s].
        torque_limit: Limit of the motor torque [N m], unless a current limit is set.
        torque_constant: Torque constant [N m/A].
        watchdog: axis.config.watchdog_timeout [s]; None: not enabled.
        heartbeat: Period of the heartbeat [s].
        encoder: Period of the estimates [s].
        torques: Period of Get_Torques [s]; 0: not sent.
        temperatures: Period of Get_Temperature [s]; 0: not sent.
        is_extended: Whether its identifiers have 29 bits.
    """

    kind: ClassVar[str] = "odrive"

    gear: float = 8.0
    direction: int = 1
    zero: float = 0.0
    inertia: float = 0.05
    friction: float = 0.1
    load: str | None = None
    position_gain: float = 20.0
    velocity_gain: float = 0.5
    integrator_gain: float = 2.0
    velocity_limit: float = 20.0
    torque_limit: float = 2.0
    torque_constant: float = 0.1
    watchdog: float | None = 0.2
    heartbeat: float = 0.1
    encoder: float = 0.01
    torques: float = 0.0
    temperatures: float = 0.0
    is_extended: bool = False

    @property
    def turn(self) -> float:
        """Position [rad] per motor turn."""
        return self.direction * 2.0 * math.pi / self.gear


class OdriveAxis(SimulatedNode, SimulatedDrive):
    """One axis: it handles frames to its node id and sends its state cyclically."""

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, OdriveConstants)
        self.spec = spec
        self.plant = plant
        self.constants = spec.constants
        self._outbox = outbox
        self.routes_changed: Callable[[], None] = lambda: None
        self.is_powered = False
        self.is_muted = False
        self.state = AxisState.UNDEFINED
        self.error = 0
        """Bits of Axis_Error."""
        self.result = SUCCESS
        self.control_mode = POSITION
        self.input = {POSITION: 0.0, VELOCITY: 0.0, TORQUE: 0.0}
        """Set-points [motor turns, turns/s, N m]; those of the modes below feed forward."""
        self.torque = 0.0
        """Of the motor [N m]."""
        self._limits = (0.0, 0.0)
        self._integral = 0.0
        self._rotor = Rotor(self.constants.inertia, self.constants.friction)
        self._now = self._booted = self._fed = self._before = 0.0
        self._periods: dict[Callable[[], tuple[int, bytes]], float] = {
            self._heartbeat: self.constants.heartbeat,
            self._estimates: self.constants.encoder,
            self._torques: self.constants.torques,
            self._temperatures: self.constants.temperatures,
        }
        self._due: dict[Callable[[], tuple[int, bytes]], float] = {}

    @property
    @override
    def servo(self) -> tuple[float, bool]:
        return self._rotor.position, self.state is AxisState.CLOSED_LOOP_CONTROL

    @property
    @override
    def condition(self) -> str:
        if not self.is_powered:
            return "off"
        return f"error {self.error:X}h" if self.error else self.state.name.lower().replace("_", " ")

    @override
    def routes(self) -> dict[int, Handler]:
        commands: dict[int, Callable[[bytes], None]] = {
            0x02: lambda data: self.fail(ESTOP_REQUESTED),
            0x07: self._request,
            0x0B: self._choose,
            0x0C: self._input_position,
            0x0D: self._input_velocity,
            0x0E: self._input_torque,
            0x0F: self._limit,
            0x16: lambda data: self.power_up(self._now),
            0x18: self._clear,
        }
        routes = {self._identifier(command): self._fed_by(act) for command, act in commands.items()}
        for answer in (self._heartbeat, self._errors, self._estimates, self._torques, self._temperatures):
            routes[self._identifier(answer()[0]) | REMOTE] = self._fed_by(
                lambda data, answer=answer: self._send(answer())  # type: ignore[misc]
            )
        routes[self._flags | BROADCAST << 5 | 0x06 | REMOTE] = lambda data, now: self._send(self._address())
        return routes

    @override
    def sync(self, now: float) -> None:
        """Ignore SYNC, which an axis does not know."""

    @override
    def power_up(self, now: float) -> None:
        self.is_powered, self.is_muted = True, False
        self.state, self.error, self.result = AxisState.UNDEFINED, INITIALIZING, SUCCESS
        self.control_mode = POSITION
        self.input = dict.fromkeys(self.input, 0.0)
        self._limits = (self.constants.velocity_limit, self.constants.torque_limit)
        self._now = self._booted = self._fed = now
        self._before = self._position()
        self._due = dict.fromkeys(self._periods, now)

    @override
    def power_down(self) -> None:
        self.is_powered = False
        self._disarm()

    @override
    def break_down(self) -> None:
        """Report a fault of the power stage."""
        self.fail(DRV_FAULT)

    def fail(self, error: int) -> None:
        """Disarm at once with an error."""
        self.error |= error
        if self.state is AxisState.CLOSED_LOOP_CONTROL:
            self.result = DISARMED
        self._disarm()

    @override
    def tick(self, now: float) -> None:
        """Advance the watchdog and the rotor, and send cyclic messages."""
        duration, self._now = now - self._now, now
        if not self.is_powered:
            return
        if self.state is AxisState.UNDEFINED and now - self._booted >= _BOOT_TIME:
            self.state, self.error = AxisState.IDLE, 0
        watchdog = self.constants.watchdog
        if watchdog is not None and now - self._fed > watchdog and self.state is not AxisState.UNDEFINED:
            self.fail(WATCHDOG_TIMER_EXPIRED)
        if duration > 0:
            self._turn(duration)
        for message, period in self._periods.items():
            if period and now >= self._due[message] - 1e-9:
                self._due[message] = max(self._due[message] + period, now)
                if not self.is_muted or message == self._heartbeat:
                    self._send(message())

    def _turn(self, duration: float) -> None:
        position, rotor = self._position(), self._rotor
        speed, self._before = (position - self._before) / duration, position
        lag = rotor.position - position
        if self.state is not AxisState.CLOSED_LOOP_CONTROL:
            rotor.position, rotor.velocity = position, speed
            return
        if abs(lag) > _LAG:
            rotor.position, rotor.velocity = position + math.copysign(_LAG, lag), speed
        constants = self.constants
        load = self.plant.read(constants.load) if constants.load else 0.0
        steps = max(1, math.ceil(duration / _SUBSTEP))
        for _ in range(steps):
            self.torque = self._cascade(rotor, duration / steps)
            rotor.push(constants.direction * constants.gear * self.torque + load, duration / steps)

    def _cascade(self, rotor: Rotor, duration: float) -> float:
        """Return the motor torque [N m] of the cascade of position and velocity loops in the present mode."""
        constants, (speed_limit, torque_limit) = self.constants, self._limits
        torque = self.input[TORQUE]
        if self.control_mode >= VELOCITY:
            speed = self.input[VELOCITY]
            if self.control_mode >= POSITION:
                turns = (rotor.position - constants.zero) / constants.turn
                speed += constants.position_gain * (self.input[POSITION] - turns)
            error = max(-speed_limit, min(speed, speed_limit)) - rotor.velocity / constants.turn
            self._integral += constants.integrator_gain * error * duration
            self._integral = max(-torque_limit, min(self._integral, torque_limit))
            torque += constants.velocity_gain * error + self._integral
        return max(-torque_limit, min(torque, torque_limit))

    def _disarm(self) -> None:
        if self.state is AxisState.CLOSED_LOOP_CONTROL:
            self.state = AxisState.IDLE
        self.torque = 0.0

    def _fed_by(self, act: Callable[[bytes], None]) -> Handler:
        """Return a handler that also feeds the watchdog, as every frame to the axis does."""

        def handle(data: bytes, now: float) -> None:
            if self.is_powered:
                self._fed = now
                act(data)

        return handle

    def _request(self, data: bytes) -> None:
        requested = int.from_bytes(data[:4], "little")
        if requested == AxisState.IDLE and self.state is not AxisState.UNDEFINED:
            self._disarm()
            self.result = SUCCESS
        elif requested == AxisState.CLOSED_LOOP_CONTROL and self.state is AxisState.IDLE:
            if self.error:
                self.result = DISARMED
                return
            self._rotor.rest(self._position())
            self._integral = 0.0
            self.state, self.result = AxisState.CLOSED_LOOP_CONTROL, SUCCESS

    def _choose(self, data: bytes) -> None:
        if len(data) == 8:
            mode, _ = struct.unpack("<ii", data)
            if mode in self.input:
                self.control_mode = mode

    def _input_position(self, data: bytes) -> None:
        if len(data) == 8:
            turns, speed, torque = struct.unpack("<fhh", data)
            self.input = {POSITION: turns, VELOCITY: speed * 0.001, TORQUE: torque * 0.001}

    def _input_velocity(self, data: bytes) -> None:
        if len(data) == 8:
            self.input[VELOCITY], self.input[TORQUE] = struct.unpack("<ff", data)

    def _input_torque(self, data: bytes) -> None:
        if len(data) >= 4:
            (self.input[TORQUE],) = struct.unpack_from("<f", data)

    def _limit(self, data: bytes) -> None:
        if len(data) == 8:
            speed, current = struct.unpack("<ff", data)
            self._limits = (speed, current * self.constants.torque_constant)

    def _clear(self, data: bytes) -> None:
        if self.state is not AxisState.UNDEFINED:
            self.error = 0

    def _position(self) -> float:
        return self.plant.read(self.spec.element)

    def _heartbeat(self) -> tuple[int, bytes]:
        return 0x01, struct.pack("<IBBBx", self.error, self.state, self.result, 0)

    def _errors(self) -> tuple[int, bytes]:
        return 0x03, struct.pack("<II", self.error, self.error)

    def _address(self) -> tuple[int, bytes]:
        return 0x06, bytes([self.spec.node & 0xFF]) + self.spec.serial.to_bytes(6, "little") + b"\0"

    def _estimates(self) -> tuple[int, bytes]:
        constants = self.constants
        turns = (self._position() - constants.zero) / constants.turn
        return 0x09, struct.pack("<ff", turns, self._rotor.velocity / constants.turn)

    def _temperatures(self) -> tuple[int, bytes]:
        return 0x15, struct.pack("<ff", 35.0, 30.0)

    def _torques(self) -> tuple[int, bytes]:
        return 0x1C, struct.pack("<ff", self.torque, self.torque)

    @property
    def _flags(self) -> int:
        return EXTENDED if self.constants.is_extended else 0

    def _identifier(self, command: int) -> int:
        return self._flags | self.spec.node << 5 | command

    def _send(self, frame: tuple[int, bytes]) -> None:
        if self.is_powered:
            command, data = frame
            self._outbox.append((self._identifier(command), data))
