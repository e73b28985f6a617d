"""Absolute encoders: position value and alarms.

Source: CiA 406, version 4.0: 6004h (position value), 6503h (alarms).
"""

import struct
from dataclasses import dataclass

from hal.protocols.cia301 import Mapped

PROFILE = 406

MEASURING_UNITS = Mapped(0x6001, 0, 32)
POSITION = Mapped(0x6004, 0, 32)
ALARMS = Mapped(0x6503, 0, 16)

VALUE = (POSITION, ALARMS)
"""What the encoder's TPDO carries."""
VALUE_LAYOUT = struct.Struct("<IH")

POSITION_ERROR = 0x0001
COMMISSIONING_DIAGNOSTIC = 0x0002


@dataclass(frozen=True, slots=True)
class Value:
    """What an encoder's TPDO says.

    Attributes:
        counts: Position value [counts].
        alarms: Bits of 6503h; with any set the position is not to be used.
    """

    counts: int
    alarms: int


def value(data: bytes | bytearray) -> Value | None:
    """What a TPDO says; None if its length is wrong."""
    return Value(*VALUE_LAYOUT.unpack(data)) if len(data) == VALUE_LAYOUT.size else None


def describe_alarms(alarms: int) -> str:
    """Alarm bits in words; empty if there is none."""
    bits = ((POSITION_ERROR, "position error"), (COMMISSIONING_DIAGNOSTIC, "commissioning diagnostic failed"))
    known = [text for bit, text in bits if alarms & bit]
    other = alarms & ~(POSITION_ERROR | COMMISSIONING_DIAGNOSTIC)
    return ", ".join([*known, f"alarms {other:04X}h"] if other else known)
