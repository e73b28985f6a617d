"""Servo drives in MIT mode: one frame carries position, velocity, torque and gains, one frame answers it.

Sources, besides those of the motors (`hal.protocols.mit_motors`):
    command, answer and the frames FFh...FCh to FEh: mini-cheetah firmware, github.com/bgkatz/motorcontrol at 3586419,
        Core/Src/can.c (`unpack_cmd`, `pack_reply`) and Core/Src/stm32f4xx_it.c (`can_tx_rx`);
    temperature and error in answers of 8 bytes: CubeMars AK Series Actuator Driver Manual V1.0.8, section 5.3, p. 49;
        the offset of -40 degrees is in the receive routine of its later versions; error codes as in
        github.com/neurobionics/TMotorCANControl at bb8d071, src/TMotorCANControl/mit_can.py (`MIT_Params`);
    Damiao's answers, FBh and registers: github.com/jia-xie/python-damiao-driver at 3c6773a,
        docs/concept/communication-protocol.md and registers.md; github.com/enactic/openarm_can at 9866604,
        src/openarm/damiao_motor/dm_motor_control.cpp and include/openarm/damiao_motor/dm_motor_constants.hpp; the
        unit of the timeout also in wiki.seeedstudio.com/damiao_series, "CAN Timeout".

Numbers are fractions of a range -r..r (gains 0..r) in 16 or 12 bits: value = low + counts * span / (2^bits - 1). The
firmware and all published hosts truncate to counts (`math_ops.c: float_to_uint` casts to int). We round to the nearest
count, half a count downwards. This is never less exact, gives 7FFFh and 7FFh for zero as truncation does, and
reproduces the counts from which a value was read. (Page 51 of the CubeMars manual multiplies by 2^bits instead, which
would overflow the largest value to the smallest; its inverse divides by 2^bits - 1.)
"""

import math
import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import NamedTuple

NODES = 0x7FF
"""Largest id of a drive."""
COMMAND_LAYOUT = struct.Struct(">Q")
"""Position 16, velocity 12, stiffness 12, damping 12, torque 12 bits, most significant first."""
POSITION_TOP, TOP = 2**16 - 1, 2**12 - 1
"""Largest counts of a position, and of all other values."""
T_MOTOR_COLDEST = -40
"""Temperature [degrees Celsius] at count 0 in an answer of T-Motor."""
_PREFIX = b"\xff" * 7


class Layout(StrEnum):
    """The layout of an answer, which depends on the maker."""

    MINI_CHEETAH = "mini_cheetah"
    """id, position, velocity, current; a seventh byte with the bus voltage in newer firmware."""
    T_MOTOR = "t_motor"
    """id, position, velocity, torque; newer firmware adds temperature and error."""
    DAMIAO = "damiao"
    """State and id in one byte, position, velocity, torque, temperatures of driver and rotor."""


SIZES: dict[Layout, tuple[int, ...]] = {Layout.MINI_CHEETAH: (6, 7), Layout.T_MOTOR: (6, 8), Layout.DAMIAO: (8,)}
"""Data bytes that an answer may have."""


class Special(IntEnum):
    """Last byte of a frame whose other seven are FFh."""

    CLEAR = 0xFB
    """Clear the fault; Damiao only."""
    ENTER = 0xFC
    """Power on and follow commands."""
    EXIT = 0xFD
    """Power off. It is answered like any frame, so a drive without power can be asked for its position."""
    ZERO = 0xFE
    """Set the present position to zero."""


class Register(IntEnum):
    """Registers of Damiao drives that the driver uses."""

    MASTER_ID = 7
    NODE_ID = 8
    TIMEOUT = 9
    """After this time without a frame the drive powers off with error Dh; 0: never."""
    MODE = 10
    SERIAL = 15
    POSITION_RANGE = 21
    VELOCITY_RANGE = 22
    EFFORT_RANGE = 23


REGISTERS = 0x7FF
"""Identifier of register requests to all Damiao drives."""
TIMEOUT_UNIT = 50e-6
"""Unit of register 9 [s]."""
MIT_MODE = 1
"""Value of register 10."""
_READ, _WRITE = 0x33, 0x55
_REGISTER_LAYOUT = struct.Struct("<HBB4s")

ENABLED, DISABLED = 1, 0
"""States in an answer of Damiao; a value above 1 is an error."""
_T_MOTOR_ERRORS = {
    1: "the motor is too hot",
    2: "overcurrent",
    3: "overvoltage",
    4: "undervoltage",
    5: "encoder fault",
    6: "unbalanced phase currents; the hardware may be damaged",
}
_DAMIAO_ERRORS = {
    0x8: "overvoltage",
    0x9: "undervoltage",
    0xA: "overcurrent",
    0xB: "the driver is too hot",
    0xC: "the rotor is too hot",
    0xD: "no frame for longer than its CAN timeout",
    0xE: "overload",
}


@dataclass(frozen=True, slots=True)
class Ranges:
    """Values at the largest counts. Position, velocity and torque range from -r to r, gains from 0 to r.

    Attributes:
        position: Position of the motor's output [rad].
        velocity: Velocity [rad/s].
        effort: Torque [N m].
        stiffness: Stiffness kp [N m/rad].
        damping: Damping kd [N m s/rad].
    """

    position: float
    velocity: float
    effort: float
    stiffness: float = 500.0
    damping: float = 5.0


class Command(NamedTuple):
    """A command to a drive: torque = stiffness * (position - p) + damping * (velocity - v) + effort.

    Attributes:
        position: Position [rad].
        velocity: Velocity [rad/s].
        stiffness: Stiffness [N m/rad].
        damping: Damping [N m s/rad].
        effort: Torque [N m].
    """

    position: float
    velocity: float
    stiffness: float
    damping: float
    effort: float


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer of a drive.

    Attributes:
        node: Its id; for Damiao only the lower four bits.
        state: Damiao: 0 disabled, 1 enabled, above 1 an error. Others: the error; 0 if none or not reported.
        position: Position [rad]; NaN at the ends of the range, beyond which it cannot be measured.
        velocity: Velocity [rad/s]; NaN at the ends of the range.
        effort: Torque [N m]; NaN at the ends of the range.
        temperature: Temperature of the rotor [degrees Celsius]; NaN if not reported.
        temperature_driver: Temperature of the driver [degrees Celsius]; NaN if not reported.
    """

    node: int
    state: int
    position: float
    velocity: float
    effort: float
    temperature: float = math.nan
    temperature_driver: float = math.nan


@dataclass(frozen=True, slots=True)
class RegisterAnswer:
    """The answer to reading or writing a register of a Damiao drive.

    Attributes:
        node: The drive's id.
        register: Number of the register, which may be missing in `Register`.
        data: Its four bytes.
    """

    node: int
    register: int
    data: bytes

    @property
    def integer(self) -> int:
        """Value of a register that holds an unsigned integer."""
        return int.from_bytes(self.data, "little")

    @property
    def real(self) -> float:
        """Value of a register that holds a float."""
        return float(struct.unpack("<f", self.data)[0])


def to_counts(value: float, low: float, high: float, top: int) -> int:
    """Return the nearest counts 0..top of a value, clipped to low..high; half a count is rounded down."""
    return math.ceil((min(max(value, low), high) - low) * top / (high - low) - 0.5)


def special(code: Special) -> bytes:
    """Return the data of a frame that changes a drive's state."""
    return _PREFIX + bytes((code,))


def pack(command: Command, ranges: Ranges) -> int:
    """Return the 64 bits of a command, to be packed by `COMMAND_LAYOUT`."""
    position, velocity, stiffness, damping, effort = command
    return (
        to_counts(position, -ranges.position, ranges.position, POSITION_TOP) << 48
        | to_counts(velocity, -ranges.velocity, ranges.velocity, TOP) << 36
        | to_counts(stiffness, 0.0, ranges.stiffness, TOP) << 24
        | to_counts(damping, 0.0, ranges.damping, TOP) << 12
        | to_counts(effort, -ranges.effort, ranges.effort, TOP)
    )


def parse_command(data: bytes | bytearray, ranges: Ranges) -> Command | Special | None:
    """Parse a frame to a drive; None if it is not eight bytes long."""
    if len(data) != 8:
        return None
    if data[:7] == _PREFIX and data[7] in Special.__members__.values():
        return Special(data[7])
    (bits,) = COMMAND_LAYOUT.unpack(data)
    return Command(
        (bits >> 48) * 2 * ranges.position / POSITION_TOP - ranges.position,
        (bits >> 36 & TOP) * 2 * ranges.velocity / TOP - ranges.velocity,
        (bits >> 24 & TOP) * ranges.stiffness / TOP,
        (bits >> 12 & TOP) * ranges.damping / TOP,
        (bits & TOP) * 2 * ranges.effort / TOP - ranges.effort,
    )


def counts(data: bytes | bytearray) -> tuple[int, int, int]:
    """Return the counts of position, velocity and torque in an answer of any layout; check its length before."""
    bits = int.from_bytes(data[1:6], "big")
    return bits >> 24, bits >> 12 & TOP, bits & TOP


def parse_answer(data: bytes | bytearray, layout: Layout, ranges: Ranges) -> Answer | None:
    """Parse an answer of a drive; None if its length is wrong."""
    if len(data) not in SIZES[layout]:
        return None
    position, velocity, effort = counts(data)
    values = (
        _symmetric(position, ranges.position, POSITION_TOP),
        _symmetric(velocity, ranges.velocity, TOP),
        _symmetric(effort, ranges.effort, TOP),
    )
    if layout is Layout.DAMIAO:
        return Answer(data[0] & 0x0F, data[0] >> 4, *values, float(data[7]), float(data[6]))
    if layout is Layout.T_MOTOR and len(data) == 8:
        return Answer(data[0], data[7], *values, float(data[6] + T_MOTOR_COLDEST))
    return Answer(data[0], 0, *values)


def _symmetric(count: int, end: float, top: int) -> float:
    return count * 2 * end / top - end if 0 < count < top else math.nan


def describe_error(state: int, layout: Layout) -> str:
    """Return an error code in words."""
    errors = _DAMIAO_ERRORS if layout is Layout.DAMIAO else _T_MOTOR_ERRORS
    return f"error {state:X}h, {errors.get(state, 'which is not documented')}"


def read_register(node: int, register: Register) -> bytes:
    """Return the data of a frame under `REGISTERS` that reads a register."""
    return _REGISTER_LAYOUT.pack(node, _READ, register, bytes(4))


def write_register(node: int, register: Register, value: int) -> bytes:
    """Return the data of a frame under `REGISTERS` that sets a register until the drive loses power."""
    return _REGISTER_LAYOUT.pack(node, _WRITE, register, value.to_bytes(4, "little"))


def parse_register(data: bytes | bytearray, node: int) -> RegisterAnswer | None:
    """Parse the answer to a register request; None for an ordinary answer of drive `node`.

    Both have the same identifier. An ordinary answer can be mistaken for this one only if the drive is disabled and
    within 0.4 % of the lower end of its range.
    """
    if len(data) != 8 or data[2] not in (_READ, _WRITE) or data[0] | data[1] << 8 != node:
        return None
    return RegisterAnswer(node, data[3], bytes(data[4:]))
