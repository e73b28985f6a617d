"""Servo drives: objects, modes of operation, the state machine, and the bits of controlword and statusword.

Source: CiA 402-2 (IEC 61800-7-201): statusword 6041h and its state coding, controlword 6040h and its commands, modes of
operation 6060h and 6502h, profile position and homing mode. Units: 6076h in thousandths of N m, 6071h, 6072h and 6077h
in thousandths of the rated torque, 6080h in revolutions per minute; positions in counts, velocities by 60A9h.
"""

from dataclasses import dataclass
from enum import IntEnum, StrEnum

from hal.protocols.cia301 import MappedObject

PROFILE = 402

ABORT_CONNECTION = MappedObject(0x6007, 0, 16, "signed")
CONTROLWORD = MappedObject(0x6040, 0, 16)
STATUSWORD = MappedObject(0x6041, 0, 16)
QUICK_STOP_OPTION = MappedObject(0x605A, 0, 16, "signed")
MODE_OF_OPERATION = MappedObject(0x6060, 0, 8, "signed")
MODE_DISPLAY = MappedObject(0x6061, 0, 8, "signed")
POSITION = MappedObject(0x6064, 0, 32, "signed")
FOLLOWING_ERROR_WINDOW = MappedObject(0x6065, 0, 32)
VELOCITY = MappedObject(0x606C, 0, 32, "signed")
TARGET_TORQUE = MappedObject(0x6071, 0, 16, "signed")
MAX_TORQUE = MappedObject(0x6072, 0, 16)
RATED_TORQUE = MappedObject(0x6076, 0, 32)
TORQUE = MappedObject(0x6077, 0, 16, "signed")
TARGET_POSITION = MappedObject(0x607A, 0, 32, "signed")
HOME_OFFSET = MappedObject(0x607C, 0, 32, "signed")
LOWEST_POSITION = MappedObject(0x607D, 1, 32, "signed")
HIGHEST_POSITION = MappedObject(0x607D, 2, 32, "signed")
MAX_PROFILE_VELOCITY = MappedObject(0x607F, 0, 32)
MAX_MOTOR_SPEED = MappedObject(0x6080, 0, 32)
PROFILE_VELOCITY = MappedObject(0x6081, 0, 32)
PROFILE_ACCELERATION = MappedObject(0x6083, 0, 32)
PROFILE_DECELERATION = MappedObject(0x6084, 0, 32)
HOMING_METHOD = MappedObject(0x6098, 0, 8, "signed")
HOMING_SPEED_SWITCH = MappedObject(0x6099, 1, 32)
HOMING_SPEED_ZERO = MappedObject(0x6099, 2, 32)
HOMING_ACCELERATION = MappedObject(0x609A, 0, 32)
VELOCITY_UNIT = MappedObject(0x60A9, 0, 32)
INTERPOLATION_SUBMODE = MappedObject(0x60C0, 0, 16, "signed")
INTERPOLATION_DATA = MappedObject(0x60C1, 1, 32, "signed")
INTERPOLATION_PERIOD = MappedObject(0x60C2, 1, 8)
INTERPOLATION_INDEX = MappedObject(0x60C2, 2, 8, "signed")
FOLLOWING_ERROR = MappedObject(0x60F4, 0, 32, "signed")
TARGET_VELOCITY = MappedObject(0x60FF, 0, 32, "signed")
SUPPORTED_MODES = MappedObject(0x6502, 0, 32)

LINEAR = 0
"""With this value of 60C0h a drive interpolates between set-points along a line."""
ABORT_QUICK_STOP = 3
"""This value of 6007h makes a lost connection cause a quick stop."""
QUICK_STOP_AND_OFF = 2
"""With this value of 605Ah a drive slows down on the quick stop ramp, then enters 'switch on disabled'."""


class OperationMode(IntEnum):
    """Modes of operation in use."""

    PROFILE_POSITION = 1
    HOMING = 6
    INTERPOLATED_POSITION = 7
    CYCLIC_SYNCHRONOUS_POSITION = 8
    CYCLIC_SYNCHRONOUS_VELOCITY = 9
    CYCLIC_SYNCHRONOUS_TORQUE = 10


_MODE_NAMES = {
    1: "profile position",
    2: "velocity",
    3: "profile velocity",
    4: "profile torque",
    6: "homing",
    7: "interpolated position",
    8: "cyclic synchronous position",
    9: "cyclic synchronous velocity",
    10: "cyclic synchronous torque",
}


class State(StrEnum):
    """States of the drive (CiA 402-2, power drive system)."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


DISABLE_VOLTAGE = 0x0000
QUICK_STOP = 0x0002
SHUTDOWN = 0x0006
SWITCH_ON = 0x0007
ENABLE_OPERATION = 0x000F
FAULT_RESET = 0x0080
"""This bit acts on its rising edge."""

NEW_SET_POINT = 1 << 4
"""Profile position: the drive takes the target position on the rising edge of this bit."""
CHANGE_AT_ONCE = 1 << 5
"""Profile position: with this bit a new target position takes effect before the previous one is reached."""
INTERPOLATE = 1 << 4
"""Interpolated position: the drive moves along the set-points while this bit is set."""
START_HOMING = 1 << 4
"""Homing begins with this bit and continues while it is set."""

WARNING = 1 << 7
REMOTE = 1 << 9
"""The drive follows the controlword if this bit is set; else it is controlled from its own panel."""
TARGET_REACHED = 1 << 10
SET_POINT_TAKEN = 1 << 12
"""Profile position: this bit is the answer to `NEW_SET_POINT`."""
HOMING_ATTAINED = 1 << 12
HOMING_ERROR = 1 << 13

_CODING = (  # mask, value, state
    (0x4F, 0x00, State.NOT_READY),
    (0x4F, 0x40, State.SWITCH_ON_DISABLED),
    (0x6F, 0x21, State.READY_TO_SWITCH_ON),
    (0x6F, 0x23, State.SWITCHED_ON),
    (0x6F, 0x27, State.OPERATION_ENABLED),
    (0x6F, 0x07, State.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, State.FAULT_REACTION),
    (0x4F, 0x08, State.FAULT),
)


def _state_of(statusword: int) -> State:
    return next((state for mask, value, state in _CODING if statusword & mask == value), State.NOT_READY)


STATE_OF = tuple(_state_of(bits) for bits in range(0x70))
"""State by `statusword & 0x6F`; a coding outside the standard is not ready."""

_TOWARDS_ENABLED = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY_TO_SWITCH_ON: SWITCH_ON,
    State.SWITCHED_ON: ENABLE_OPERATION,
    State.OPERATION_ENABLED: ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: DISABLE_VOLTAGE,
}


def state(statusword: int) -> State:
    """Return the state in a statusword."""
    return STATE_OF[statusword & 0x6F]


def supports(modes: int, mode: OperationMode) -> bool:
    """Return whether the drive has a mode, by its object 6502h."""
    return bool(modes >> (mode - 1) & 1)


def describe_modes(modes: int) -> str:
    """Return the modes in object 6502h in words."""
    return ", ".join(name for mode, name in _MODE_NAMES.items() if modes >> (mode - 1) & 1) or "none"


def describe_mode(mode: int) -> str:
    """Return a value of 6060h or 6061h in words."""
    return _MODE_NAMES.get(mode, f"mode {mode}")


def interpolation(period: float) -> tuple[int, int]:
    """Return value and power of ten of object 60C2h nearest to a period [s]: 5 and -3 for 5 ms.

    Milliseconds (-3), which every drive supports, are preferred.
    """
    pairs = [(round(period * 10**-index), index) for index in range(-1, -7, -1)]
    valid = [(value, index) for value, index in pairs if 1 <= value <= 255]
    return min(valid, key=lambda pair: (round(abs(pair[0] * 10.0 ** pair[1] / period - 1), 4), abs(pair[1] + 3)))


@dataclass(frozen=True, slots=True)
class VelocityUnit:
    """The unit of a velocity object.

    Attributes:
        per_second: Counts, or motor turns, in a second at a velocity of 1.
        is_turns: Whether `per_second` counts motor turns.
    """

    per_second: float
    is_turns: bool

    def counts_per_second(self, counts_per_turn: float) -> float:
        """Return the counts per second at a velocity of 1."""
        return self.per_second * counts_per_turn if self.is_turns else self.per_second


VELOCITY_UNITS = {
    "counts/s": VelocityUnit(1.0, is_turns=False),
    "rps": VelocityUnit(1.0, is_turns=True),
    "rpm": VelocityUnit(1 / 60, is_turns=True),
    "0.1 rpm": VelocityUnit(0.1 / 60, is_turns=True),
    "mrpm": VelocityUnit(1e-3 / 60, is_turns=True),
}
"""Units by their names in a robot file."""

_TURN, _INCREMENT, _SECOND, _MINUTE = 0xB4, 0xB5, 0x03, 0x47


def velocity_unit(code: int) -> VelocityUnit | None:
    """Return the unit in object 60A9h; None if it is not a motor speed.

    The code has power of ten, numerator and denominator (CiA 303-2): 00B44700h is revolutions per minute, FDB44700h a
    thousandth of that, 00B50300h increments per second.
    """
    exponent = (code >> 24 ^ 0x80) - 0x80
    numerator, denominator = code >> 16 & 0xFF, code >> 8 & 0xFF
    if numerator not in (_TURN, _INCREMENT) or denominator not in (_SECOND, _MINUTE) or not -12 <= exponent <= 12:
        return None
    per_second = 10.0**exponent / (60 if denominator == _MINUTE else 1)
    return VelocityUnit(per_second, is_turns=numerator == _TURN)


def towards_enabled(now: State) -> int:
    """Return the controlword for one step from state `now` towards operation enabled; it never leaves a fault."""
    return _TOWARDS_ENABLED.get(now, DISABLE_VOLTAGE)


def towards_disabled(now: State, slow_down: bool = False) -> int:
    """Return the controlword for one step from state `now` towards ready to switch on.

    Args:
        now: State of the drive.
        slow_down: Whether to disable the operation first, so that the drive stops on its slow down ramp (605Ch).
    """
    if now is State.OPERATION_ENABLED and slow_down:
        return SWITCH_ON
    return (
        SHUTDOWN if now in (State.OPERATION_ENABLED, State.SWITCHED_ON, State.READY_TO_SWITCH_ON) else DISABLE_VOLTAGE
    )
