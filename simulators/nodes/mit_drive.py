"""A simulated servo drive in MIT mode: T-Motor, Damiao or mini-cheetah, with its rotor, its memory and its faults.

The source is the documents that `hal.protocols.mit` names; no code is shared. If firmwares differ, the node has the
worst behaviour: T-Motor ignores frames while it is off and follows its last frame again when motor mode is entered,
and its position wraps to the other end of its range.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

from typing_extensions import override

from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.node import Frame, Handler, SimulatedDrive, SimulatedNode
from simulators.nodes.plant import Plant
from simulators.nodes.rotor import Rotor

REGISTER_ID = 0x7FF
_MASTER_ID, _OWN_ID, _TIMEOUT, _MODE, _SERIAL = 7, 8, 9, 10, 15
_RANGES = (21, 22, 23)
_WRITABLE = (_MASTER_ID, _OWN_ID, _TIMEOUT, _MODE, *_RANGES)
_TICKS_PER_SECOND = 20_000
"""The timeout register counts in this unit."""
_SUBSTEP = 5e-4
"""The rotor is advanced in steps of at most this [s]; a firmware closes this loop at 20 to 40 kHz."""
_LAG = 0.2
"""The rotor is at most this far [rad] from the world's position, so an obstacle blocks both."""
_AMBIENT = 25.0
"""The surroundings have this temperature [degrees Celsius]."""
_COOLING = 120.0
"""This is the time constant of the rotor's temperature [s]."""
_TOO_HOT = {"t_motor": 1, "damiao": 0xC, "mini_cheetah": 0}
_LOST = 0xD


@dataclass(frozen=True, slots=True)
class MitConstants:
    """A drive in MIT mode. position [rad or m] = zero + direction * angle / gear * (spool_radius or 1).

    Attributes:
        make: Maker of its firmware.
        master_id: Identifier of its answers; None: 0, or for Damiao its id + 16.
        position: Range of positions in frames [rad].
        velocity: Range of velocities [rad/s].
        torque: Range of torques [N m].
        stiffness: Range of stiffness [N m/rad].
        damping: Range of damping [N m s/rad].
        gear: Turns of its output per turn of the joint or spool.
        spool_radius: Radius of the spool [m]; None for a joint.
        direction: +1 if its angle grows with the position, else -1.
        zero: Position where its angle is zero [rad or m].
        inertia: Inertia at its output [kg m2].
        friction: Friction at its output [N m s/rad].
        load: `signal.element` of the effort that pulls towards growing position [N m or N]; None: no load.
        is_long: Whether answers have temperature and error.
        heating: Heating of the rotor [K/s per (N m)^2].
        hottest: Temperature above which it powers off [degrees Celsius].
    """

    kind: ClassVar[str] = "mit_drive"

    make: Literal["t_motor", "damiao", "mini_cheetah"] = "damiao"
    master_id: int | None = None
    position: float = 12.5
    velocity: float = 30.0
    torque: float = 10.0
    stiffness: float = 500.0
    damping: float = 5.0
    gear: float = 1.0
    spool_radius: float | None = None
    direction: int = 1
    zero: float = 0.0
    inertia: float = 0.05
    friction: float = 0.1
    load: str | None = None
    is_long: bool = True
    heating: float = 0.01
    hottest: float = 100.0

    @property
    def unit(self) -> float:
        """Position [rad or m] per radian of its output."""
        return self.direction / self.gear * (self.spool_radius or 1.0)


@dataclass(frozen=True, slots=True)
class MitCommand:
    """Command that the drive follows: position [rad], velocity [rad/s], gains, torque [N m]."""

    position: float = 0.0
    velocity: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    torque: float = 0.0


class MitDriveNode(SimulatedNode, SimulatedDrive):
    """One drive: it answers each frame with one frame, and its rotor follows the last command."""

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, MitConstants)
        self.spec = spec
        self.plant = plant
        self._constants = spec.constants
        self._outbox = outbox
        self.is_powered = False
        self.is_muted = False
        self.routes_changed: Callable[[], None] = lambda: None
        self.is_on = False
        """Whether the motor has power, and follows."""
        self.error = 0
        """Error code as in its answers."""
        self.registers: dict[int, bytes] = {}
        self.temperature = _AMBIENT
        """Temperature of the rotor [degrees Celsius]."""
        self.torque = 0.0
        """Torque of the rotor [N m]."""
        self._rotor = Rotor(self._constants.inertia, self._constants.friction)
        self.command = MitCommand()
        """The frame that it follows."""
        self._heard = self._now = self._before = 0.0

    @property
    @override
    def servo(self) -> tuple[float, bool]:
        return self._constants.zero + self._constants.unit * self._rotor.position, self.is_on

    @property
    @override
    def condition(self) -> str:
        if not self.is_powered:
            return "off"
        return f"error {self.error:X}h" if self.error else "enabled" if self.is_on else "disabled"

    @override
    def routes(self) -> dict[int, Handler]:
        routes: dict[int, Handler] = {self.spec.node: self._on_frame}
        if self._constants.make == "damiao":
            routes[REGISTER_ID] = self._on_register
        return routes

    @override
    def sync(self, now: float) -> None:
        """Ignore SYNC, which such a drive does not know."""

    @override
    def power_up(self, now: float) -> None:
        """Start as after power-on; values written to registers are lost."""
        constants = self._constants
        self.is_powered, self.is_muted = True, False
        self._switch_off()
        self.error = 0
        self.temperature = _AMBIENT
        self.command = MitCommand()
        self._heard = self._now = now
        self._before = self._angle()
        master_id = constants.master_id
        if master_id is None:
            master_id = self.spec.node + 16 if constants.make == "damiao" else 0
        numbers = {
            _MASTER_ID: master_id,
            _OWN_ID: self.spec.node,
            _TIMEOUT: 0,
            _MODE: 2,
            _SERIAL: self.spec.serial,
        }
        ranges = zip(_RANGES, (constants.position, constants.velocity, constants.torque), strict=True)
        self.registers = {key: struct.pack("<I", value) for key, value in numbers.items()}
        self.registers |= {key: struct.pack("<f", value) for key, value in ranges}

    @override
    def power_down(self) -> None:
        self.is_powered = False
        self._switch_off()

    @override
    def break_down(self) -> None:
        """Report an overheated rotor."""
        self._fail(_TOO_HOT[self._constants.make])

    @override
    def tick(self, now: float) -> None:
        """Advance the watchdog and the rotor."""
        duration, self._now = now - self._now, now
        if not self.is_powered or duration <= 0:
            return
        timeout = self._number(_TIMEOUT)
        is_late = timeout and now - self._heard > timeout / _TICKS_PER_SECOND
        if self.is_on and self._constants.make == "damiao" and is_late:
            self._fail(_LOST)
        angle, rotor = self._angle(), self._rotor
        before, self._before = self._before, angle
        lag = rotor.position - angle
        if not self.is_on:
            rotor.position, rotor.velocity = angle, (angle - before) / duration
        elif abs(lag) > _LAG:
            rotor.position, rotor.velocity = angle + math.copysign(_LAG, lag), (angle - before) / duration
        if self.is_on:
            self._turn(duration)
        self._heat(duration)

    def _turn(self, duration: float) -> None:
        command, rotor, constants = self.command, self._rotor, self._constants
        load = self.plant.read(constants.load) * constants.unit if constants.load else 0.0
        steps = max(1, math.ceil(duration / _SUBSTEP))
        for _ in range(steps):
            asked = (
                command.stiffness * (command.position - rotor.position)
                + command.damping * (command.velocity - rotor.velocity)
                + command.torque
            )
            self.torque = max(-constants.torque, min(asked, constants.torque))
            rotor.push(self.torque + load, duration / steps)

    def _heat(self, duration: float) -> None:
        gain = self._constants.heating * self.torque**2 - (self.temperature - _AMBIENT) / _COOLING
        self.temperature += gain * duration
        if self.is_on and self.temperature > self._constants.hottest:
            self.break_down()

    def _on_frame(self, data: bytes, now: float) -> None:
        if not self.is_powered or len(data) != 8:
            return
        self._heard = now
        if self._constants.make != "damiao":
            self._answer()  # these answer first and obey then
        if data[:7] == b"\xff\xff\xff\xff\xff\xff\xff" and data[7] >= 0xFB:
            self._obey(data[7])
        else:
            self._follow(data)
        if self._constants.make == "damiao":
            self._answer()

    def _obey(self, code: int) -> None:
        if code == 0xFC and not (self.error and self._constants.make == "damiao"):
            self.is_on = True
            if self._constants.make == "t_motor":
                self.error = 0
        elif code == 0xFD:
            self._switch_off()
        elif code == 0xFB and self._constants.make == "damiao":
            self.error = 0

    def _follow(self, data: bytes) -> None:
        constants = self._constants
        if constants.make == "t_motor" and not self.is_on:
            return
        if constants.make == "damiao" and self._number(_MODE) != 1:
            return
        position = data[0] * 256 + data[1]
        velocity = data[2] * 16 + data[3] // 16
        stiffness = data[3] % 16 * 256 + data[4]
        damping = data[5] * 16 + data[6] // 16
        torque = data[6] % 16 * 256 + data[7]
        self.command = MitCommand(
            (position / 65535 * 2 - 1) * constants.position,
            (velocity / 4095 * 2 - 1) * constants.velocity,
            stiffness / 4095 * constants.stiffness,
            damping / 4095 * constants.damping,
            (torque / 4095 * 2 - 1) * constants.torque,
        )

    def _on_register(self, data: bytes, now: float) -> None:
        if not self.is_powered or len(data) != 8 or data[0] + 256 * data[1] != self.spec.node:
            return
        kind, register = data[2], data[3]
        if kind == 0xCC:
            self._answer()
        elif kind in (0x33, 0x55) and register in self.registers:
            if kind == 0x55 and register in _WRITABLE:
                self.registers[register] = data[4:8]
            self._send(data[:4] + self.registers[register])

    def _answer(self) -> None:
        constants, rotor = self._constants, self._rotor
        angle = self._angle()
        position = int((angle / constants.position + 1) / 2 * 65535)
        if constants.make == "damiao":
            position = max(0, min(position, 65535))
        position %= 65536
        velocity = self._twelve_bits(rotor.velocity, constants.velocity)
        torque = self._twelve_bits(self.torque, constants.torque)
        first = self.spec.node & 0xFF
        if constants.make == "damiao":
            first = (self.error or int(self.is_on)) * 16 + self.spec.node % 16
        head = bytes(
            (first, position // 256, position % 256, velocity // 16, velocity % 16 * 16 + torque // 256, torque % 256)
        )
        degrees = round(self.temperature)
        tail = b""
        if constants.make == "damiao":
            tail = bytes((round(_AMBIENT) + 5, degrees))
        elif constants.make == "t_motor" and constants.is_long:
            tail = bytes((degrees + 40, self.error))
        self._send(head + tail)

    def _send(self, data: bytes) -> None:
        if not self.is_muted:
            self._outbox.append((self._number(_MASTER_ID), data))

    def _angle(self) -> float:
        return (self.plant.read(self.spec.element) - self._constants.zero) / self._constants.unit

    def _number(self, register: int) -> int:
        return int.from_bytes(self.registers[register], "little")

    def _fail(self, error: int) -> None:
        self.error = error
        self._switch_off()

    def _switch_off(self) -> None:
        self.is_on = False
        self.torque = 0.0
        if self._constants.make != "t_motor":
            self.command = MitCommand()

    @staticmethod
    def _twelve_bits(value: float, end: float) -> int:
        return int((max(-end, min(value, end)) / end + 1) / 2 * 4095)
