"""Servo drives: the state machine, and the process data of cyclic synchronous position mode.

Source: CiA 402-2 (IEC 61800-7-201): statusword 6041h and its state coding, controlword 6040h and its commands.
"""

import struct
from dataclasses import dataclass
from enum import StrEnum

from hal.protocols.cia301 import Mapped

PROFILE = 402

CONTROLWORD = Mapped(0x6040, 0, 16)
STATUSWORD = Mapped(0x6041, 0, 16)
MODE_OF_OPERATION = Mapped(0x6060, 0, 8, "signed")
POSITION = Mapped(0x6064, 0, 32, "signed")
MAX_TORQUE = Mapped(0x6072, 0, 16)
TORQUE = Mapped(0x6077, 0, 16, "signed")
TARGET_POSITION = Mapped(0x607A, 0, 32, "signed")
ABORT_CONNECTION = Mapped(0x6007, 0, 16, "signed")

CYCLIC_SYNCHRONOUS_POSITION = 8
ABORT_QUICK_STOP = 3
"""Value of 6007h: a lost connection is a quick stop."""

COMMAND = (CONTROLWORD, TARGET_POSITION)
"""What the drive's RPDO carries."""
STATUS = (STATUSWORD, POSITION, TORQUE)
"""What the drive's TPDO carries."""
COMMAND_LAYOUT = struct.Struct("<Hi")
STATUS_LAYOUT = struct.Struct("<Hih")


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
"""Acts on its rising edge."""

WARNING_BIT = 1 << 7

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
"""State by `statusword & 0x6F`; a coding that the standard does not have counts as not ready."""

_TOWARDS_ENABLED = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY_TO_SWITCH_ON: SWITCH_ON,
    State.SWITCHED_ON: ENABLE_OPERATION,
    State.OPERATION_ENABLED: ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: DISABLE_VOLTAGE,
}


@dataclass(frozen=True, slots=True)
class Status:
    """What a drive's TPDO says.

    Attributes:
        state: State of the drive.
        position: Position actual value [counts].
        torque: Torque actual value [thousandths of the rated torque].
    """

    state: State
    position: int
    torque: int


def state(statusword: int) -> State:
    """The state that a statusword codes."""
    return STATE_OF[statusword & 0x6F]


def status(data: bytes | bytearray) -> Status | None:
    """What a TPDO says; None if its length is wrong."""
    if len(data) != STATUS_LAYOUT.size:
        return None
    statusword, position, torque = STATUS_LAYOUT.unpack(data)
    return Status(state(statusword), position, torque)


def towards_enabled(now: State) -> int:
    """The controlword that leads a drive in state `now` one step towards operation enabled; never out of a fault."""
    return _TOWARDS_ENABLED.get(now, DISABLE_VOLTAGE)


def towards_disabled(now: State) -> int:
    """The controlword that lets a drive in state `now` go, in a controlled way, to ready to switch on."""
    return (
        SHUTDOWN if now in (State.OPERATION_ENABLED, State.SWITCHED_ON, State.READY_TO_SWITCH_ON) else DISABLE_VOLTAGE
    )
