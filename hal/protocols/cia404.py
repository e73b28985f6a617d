"""Measuring devices: the process value of an analogue input, its unit, digits and status.

Source: CiA 404 as far as makers' manuals quote it (9130h, 6131h, 6132h, 6150h), CiA 303-2 for units.
"""

import struct
from dataclasses import dataclass

from hal.protocols.cia301 import Mapped

PROFILE = 404
CHANNEL = 1
"""The sub-index of the first, and here only, measuring channel."""

UNIT = Mapped(0x6131, CHANNEL, 32)
DIGITS = Mapped(0x6132, CHANNEL, 8)
STATUS = Mapped(0x6150, CHANNEL, 8)
PROCESS_VALUE = Mapped(0x9130, CHANNEL, 32, "signed")

VALUE = (PROCESS_VALUE, STATUS)
"""What the cell's TPDO carries."""
VALUE_LAYOUT = struct.Struct("<iB")

INVALID = 0x01
OVERLOAD = 0x02
UNDERLOAD = 0x04

_NEWTON = 0x21
_PREFIXES = {0x00: 0, 0x01: 1, 0x02: 2, 0x03: 3, 0x06: 6, 0xFD: -3, 0xFA: -6}


@dataclass(frozen=True, slots=True)
class Value:
    """What a cell's TPDO says.

    Attributes:
        digits: Process value [the cell's unit times 10^-decimal digits].
        status: Bits of 6150h; 0 if the value is good.
    """

    digits: int
    status: int


def value(data: bytes | bytearray) -> Value | None:
    """What a TPDO says; None if its length is wrong."""
    return Value(*VALUE_LAYOUT.unpack(data)) if len(data) == VALUE_LAYOUT.size else None


def newtons_per_digit(unit: int, digits: int) -> float | None:
    """Scale of the process value [N]: from unit 6131h and decimal digits 6132h; None if the unit is no force.

    The unit is a CiA 303-2 code: prefix in the highest byte (a power of ten), numerator in the next, as 00210000h for
    newton and 03210000h for kilonewton.
    """
    prefix, numerator, rest = unit >> 24, unit >> 16 & 0xFF, unit & 0xFFFF
    if numerator != _NEWTON or rest or prefix not in _PREFIXES:
        return None
    return 10.0 ** (_PREFIXES[prefix] - digits)


def describe_status(status: int) -> str:
    """Status bits in words; empty if the value is good."""
    bits = ((INVALID, "value not valid"), (OVERLOAD, "positive overload"), (UNDERLOAD, "negative overload"))
    known = [text for bit, text in bits if status & bit]
    other = status & ~(INVALID | OVERLOAD | UNDERLOAD)
    return ", ".join([*known, f"status {other:02X}h"] if other else known)
