"""Description of a simulated node: its address, what it measures or moves, and its own electrical constants.

The constants are those of the device, not of the robot file: a robot file whose settings disagree with its hardware
must read wrong values here as it would on a bench.
"""

import math
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

_BESIDE = Path(__file__).resolve().parents[3]
EDS_FOLDER = (_BESIDE if (_BESIDE / "robots").is_dir() else Path.cwd()) / "robots" / "eds"
"""EDS files are beside this package; a container has them in the working directory's folder of robot files."""


class Constants(Protocol):
    """Electrical constants of a node; their type says what kind of node it is."""

    kind: ClassVar[str]
    """In words that a file name can have: `servo_drive`."""


@dataclass(frozen=True, slots=True)
class DriveConstants:
    """A CiA 402 servo drive that winds a wire on a spool, or turns a joint.

    position [m or rad] = zero + direction * counts / (counts_per_turn * gear) * turn, where a turn is
    2 pi spool_radius [m], or 2 pi [rad] without a spool.

    Attributes:
        counts_per_turn: Encoder counts per motor turn.
        gear: Motor turns per turn of the output.
        spool_radius: Radius of the spool [m]; None for a joint, whose position is in rad.
        direction: +1 if counts grow with the position, else -1.
        zero: Position at zero counts [m or rad].
        rated_torque: Motor rated torque [N m], a multiple of 1e-3 as object 6076h has it.
        load: `signal.element` of the wire's tension [N] or the joint's torque [N m] that the motor carries; None: no
            load is reported by 6077h.
        modes: Modes of operation that it has (6502h): 1 profile position, 6 homing, 7 interpolated position, 8,
            9, 10 cyclic synchronous position, velocity, torque.
        velocity_unit: Object 60A9h; 00B50300h is encoder increments per second, 00B44700h revolutions per minute.
        inertia: Inertia of motor, gear and load, seen at the output [kg m2], or [kg] for a wire.
        friction: Viscous friction, seen at the output [N m s/rad], or [N s/m] for a wire.
        switches: Lowest and highest position [m or rad] at which no limit switch is active.
        heating: Final temperature rise of the winding over its surroundings (25 degC) at rated torque [K].
        thermal_time: Time constant of that rise [s].
    """

    kind: ClassVar[str] = "servo_drive"

    counts_per_turn: int = 4096
    gear: float = 29.0
    spool_radius: float | None = 0.008
    direction: int = 1
    zero: float = 0.0
    rated_torque: float = 0.1
    load: str | None = None
    modes: tuple[int, ...] = (1, 6, 7, 8, 9, 10)
    velocity_unit: int = 0x00B50300
    inertia: float = 0.05
    friction: float = 0.5
    switches: tuple[float, float] = (-math.inf, math.inf)
    heating: float = 40.0
    thermal_time: float = 60.0

    @property
    def counts_per_unit(self) -> float:
        """Counts per metre of wire, or per radian of the joint; negative if they grow the other way."""
        turn = 2.0 * math.pi * (self.spool_radius or 1.0)
        return self.direction * self.counts_per_turn * self.gear / turn


@dataclass(frozen=True, slots=True)
class CellConstants:
    """Equal load cells with a CiA 404 measuring amplifier.

    Attributes:
        capacity: Force [N] beyond which the status reports overload.
        counts_per_newton: Counts of the analogue-digital converter per N.
        unbalance: Reading of the unloaded cell before a tare [N].
        decimal_digits: Decimal digits of the integer process values: 2 means 0.01 of the unit.
        unit: Unit of the process value, coded as in CiA 303-2.
        unit_size: One of that unit [N].
        more: `signal.element` of the forces on channels 2 and up, empty for a missing cell; the first is the
            node's own.
    """

    kind: ClassVar[str] = "load_cell"

    capacity: float = 500.0
    counts_per_newton: float = 4000.0
    unbalance: float = 0.0
    decimal_digits: int = 2
    unit: int = 0x00210000
    unit_size: float = 1.0
    more: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class EncoderConstants:
    """A CiA 406 absolute encoder: angle [rad] = zero + direction * counts / counts_per_turn * 2 pi.

    Attributes:
        counts_per_turn: Physical resolution; the position value wraps after `turns` turns.
        turns: Number of turns that the encoder distinguishes.
        direction: +1 if counts grow with the angle, else -1.
        zero: Angle at zero counts [rad]; half a turn away from the middle of the joint's range avoids the wrap.
        scaled_to: Units per turn set before delivery (6000h bit 2 and 6001h, kept without power);
            None: no scaling.
        speed_unit: Multiplier and divider of the speed value (6031h).
    """

    kind: ClassVar[str] = "joint_encoder"

    counts_per_turn: int = 262144
    turns: int = 1
    direction: int = 1
    zero: float = -math.pi
    scaled_to: int | None = None
    speed_unit: tuple[int, int] = (1, 1)


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """One simulated node.

    Attributes:
        name: As a person calls it in a fault: `shoulder_roll_encoder`.
        bus: Key of the bus in the robot file.
        node: Node id; 1 to 127 on CANopen.
        element: `signal.element` of the world that it measures or moves.
        constants: Its electrical constants; their type says what kind of node it is.
        sheet: A maker's EDS file whose device it shall look like; None: ours.
    """

    name: str
    bus: str
    node: int
    element: str
    constants: Constants
    sheet: Path | None = None

    @property
    def kind(self) -> str:
        """Kind of node, such as `servo_drive`."""
        return self.constants.kind

    @property
    def eds(self) -> Path:
        """Electronic data sheet of this kind of node, if it speaks CANopen."""
        return EDS_FOLDER / f"{self.kind}.eds"

    @property
    def serial(self) -> int:
        """Serial number (1018h:4), made of the name so that it is the same in every run."""
        return zlib.crc32(self.name.encode())
