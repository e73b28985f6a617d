"""Measuring devices: the value of an analogue input in its several forms, its unit, digits, status and tare.

Source: CiA 404 as far as makers' manuals quote it (7100h, 6125h, 6130h, 6131h, 6132h, 6150h); the sub-index is the
channel. The first digit of an index tells the type: 6 the type of the device (here REAL32), 7 INTEGER16, 9 INTEGER32.
"""

from dataclasses import dataclass

from hal.protocols.cia301 import Mapped

PROFILE = 404

OFFSET = 0x6124
"""REAL32, writable: what a tare has added to the value, in the unit of the process value."""
AUTOZERO = 0x6125
ZERO = int.from_bytes(b"zero", "little")
"""Signature that tares a channel when it is written to 6125h."""
UNIT = 0x6131
DIGITS = 0x6132
STATUS = Mapped(0x6150, 0, 8)
"""Without its channel."""

INVALID = 0x01
OVERLOAD = 0x02
UNDERLOAD = 0x04


@dataclass(frozen=True, slots=True)
class Form:
    """One form in which a device offers what it measures; the sub-index of its objects is still the channel's to fill.

    Attributes:
        value: The object that is mapped.
        has_unit: Its unit is 6131h; if not, it is raw counts.
        has_digits: It is a whole number of 10^-n units, where n is 6132h.
        status: The object beside it that tells whether the value is good; 0 is good. None if there is none.
    """

    value: Mapped
    has_unit: bool = True
    has_digits: bool = False
    status: Mapped | None = STATUS


FORMS = {
    "float32": Form(Mapped(0x6130, 0, 32, "float")),
    "int16": Form(Mapped(0x7130, 0, 16, "signed"), has_digits=True),
    "int32": Form(Mapped(0x9130, 0, 32, "signed"), has_digits=True),
    "counts16": Form(Mapped(0x7100, 0, 16, "signed"), has_unit=False),
    "counts32": Form(Mapped(0x9100, 0, 32, "signed"), has_unit=False),
}
"""The process value in three types, and the field value: what the converter counted, before any scaling."""


def describe_status(status: int) -> str:
    """Status bits in words; empty if the value is good."""
    bits = ((INVALID, "value not valid"), (OVERLOAD, "positive overload"), (UNDERLOAD, "negative overload"))
    known = [text for bit, text in bits if status & bit]
    other = status & ~(INVALID | OVERLOAD | UNDERLOAD)
    return ", ".join([*known, f"status {other:02X}h"] if other else known)
