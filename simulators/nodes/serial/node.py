"""A simulated servo on a serial line, whatever its make: motion, and what its registers say of the world."""

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

from typing_extensions import override

from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.node import Handler, SimulatedDrive, SimulatedNode
from simulators.nodes.plant import Plant

COUNTS, MIDDLE = 4096, 2048
PER_COUNT = 2.0 * math.pi / COUNTS
SMOOTHING = 0.02
"""The measured speed is smoothed over this time [s]."""


@dataclass(frozen=True, slots=True)
class SerialConstants:
    """A servo on a serial line. position [rad or m] = zero + direction * angle / gear * (spool_radius or 1).

    Attributes:
        make: Maker, which decides the protocol.
        model: Model number.
        firmware: Version.
        gear: Turns of its output per turn of the joint or spool.
        spool_radius: Radius of the spool [m]; None for a joint.
        direction: +1 if its counts grow with the position, else -1.
        zero: Position at count 2048 [rad or m].
        lowest: Lowest count that it accepts as a goal.
        highest: Highest count that it accepts as a goal.
        fastest: Speed without load [rad/s].
        stiffness: Share of its largest drive per radian of lag [1/rad].
        stall_current: Current at the largest drive [A].
        has_dead_watchdog: Whether its watchdog reports a stop that it does not perform.
        load: `signal.element` of the load or current that it carries; None: its drive follows from its lag alone.
        full_load: Value of that element at the largest drive [its unit].
    """

    kind: ClassVar[str] = "serial_servo"

    make: Literal["feetech", "dynamixel"] = "feetech"
    model: int = 777
    firmware: int = 45
    gear: float = 1.0
    spool_radius: float | None = None
    direction: int = 1
    zero: float = 0.0
    lowest: int = 0
    highest: int = 4095
    fastest: float = 5.0
    stiffness: float = 8.0
    stall_current: float = 2.4
    has_dead_watchdog: bool = False
    load: str | None = None
    full_load: float = 1.0

    @property
    def unit(self) -> float:
        """Position [rad or m] per radian of its output."""
        return self.direction / self.gear * (self.spool_radius or 1.0)


class SerialNode(SimulatedNode, SimulatedDrive, abc.ABC):
    """One servo: a table of registers, a rotor that follows the goal, and an answer to each packet."""

    SIZE: ClassVar[int]

    def __init__(self, spec: NodeSpec, plant: Plant) -> None:
        assert isinstance(spec.constants, SerialConstants)
        self.spec = spec
        self.plant = plant
        self.constants = spec.constants
        self.is_powered = False
        self.is_muted = False
        self.routes_changed: Callable[[], None] = lambda: None
        self.table = bytearray(self.SIZE)
        self.speed = 0.0
        """Measured speed of its output [rad/s]."""
        self._target = 0.0
        self._before = 0.0
        self._now = 0.0
        self._deaf_until = -math.inf

    @property
    @abc.abstractmethod
    def is_on(self) -> bool:
        """Whether its torque is on."""

    @property
    @abc.abstractmethod
    def goal(self) -> float:
        """Angle that it turns to [rad], or NaN if it turns at `goal_speed`."""

    @property
    @abc.abstractmethod
    def goal_speed(self) -> float:
        """Speed at which it turns without a goal, and its highest speed with one [rad/s]."""

    @abc.abstractmethod
    def answer(self, instruction: int, parameters: bytes, is_broadcast: bool, now: float) -> bytes | None:
        """Return the status packet that answers an instruction; None without one."""

    @abc.abstractmethod
    def reset_memory(self) -> None:
        """Set the registers that lose their values with the supply."""

    @property
    @override
    def servo(self) -> tuple[float, bool]:
        return self.constants.zero + self.constants.unit * self._target, self.is_powered and self.is_on

    @property
    @override
    def condition(self) -> str:
        if not self.is_powered:
            return "off"
        return f"error {self.error:02X}h" if self.error else "enabled" if self.is_on else "disabled"

    @property
    @abc.abstractmethod
    def error(self) -> int:
        """Bits of its errors."""

    @override
    def routes(self) -> dict[int, Handler]:
        """Return nothing: a line has no identifiers."""
        return {}

    @override
    def sync(self, now: float) -> None:
        """Ignore SYNC, which a line does not have."""

    @property
    def angle(self) -> float:
        """Measured angle of its output [rad], 0 at count 2048."""
        return (self.plant.read(self.spec.element) - self.constants.zero) / self.constants.unit

    @property
    def counts(self) -> int:
        """Measured count."""
        return MIDDLE + round(self.angle / PER_COUNT)

    @property
    def drive(self) -> float:
        """Share of the largest drive, with sign; a load is carried, by a brake if the torque is off."""
        constants = self.constants
        if constants.load is not None:
            share = constants.direction * self.plant.read(constants.load) / constants.full_load
        elif self.is_on:
            share = constants.stiffness * (self._target - self.angle)
        else:
            return 0.0
        return max(-1.0, min(1.0, share))

    def is_deaf(self, now: float) -> bool:
        """Whether it does not listen at present: no supply, or busy with its memory."""
        return not self.is_powered or now < self._deaf_until

    def be_deaf(self, duration: float, now: float) -> None:
        """Not listen for `duration` [s]."""
        self._deaf_until = now + duration

    @override
    def power_up(self, now: float) -> None:
        self.is_powered, self.is_muted = True, False
        self._now, self._deaf_until = now, -math.inf
        self._target = self._before = self.angle
        self.speed = 0.0
        self.reset_memory()

    @override
    def power_down(self) -> None:
        self.is_powered = False

    @override
    def tick(self, now: float) -> None:
        """Advance the rotor, which is where the world is while it has no torque."""
        duration, self._now = now - self._now, now
        if not self.is_powered or duration <= 0:
            return
        angle = self.angle
        share = min(1.0, duration / SMOOTHING)
        self.speed += share * ((angle - self._before) / duration - self.speed)
        self._before = angle
        if not self.is_on:
            self._target = angle
            return
        most = min(abs(self.goal_speed), self.constants.fastest) * duration
        if math.isnan(self.goal):
            self._target += math.copysign(most, self.goal_speed)
        else:
            self._target += max(-most, min(most, self.goal - self._target))

    def halt(self) -> None:
        """Stay at the present angle."""
        self._target = self.angle

    def number(self, address: int, size: int, is_signed: bool = False) -> int:
        """Return a register as a whole number, low byte first."""
        return int.from_bytes(self.table[address : address + size], "little", signed=is_signed)

    def put(self, address: int, size: int, value: int, is_signed: bool = False) -> None:
        """Set a register."""
        self.table[address : address + size] = value.to_bytes(size, "little", signed=is_signed)
