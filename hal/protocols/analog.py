"""Analogue inputs and measuring devices: objects of CiA 401 and CiA 404, and unit codes of CiA 303-2.

CiA 401, version 3: 6401h, 6402h, 6403h (analogue inputs; the sub-index is the channel) and 6423h (global interrupt
enable: while it is FALSE, as after power-on, no PDO with an analogue input is sent on an event). An input with fewer
bits than its object is shifted to the left, so that full scale is full scale of the object.

CiA 404 as far as makers' manuals quote it: 7100h, 6125h, 6130h, 6131h, 6132h, 6150h; the sub-index is the channel. The
first digit of an index stands for the type: 6 the type of the device (here REAL32), 7 INTEGER16, 9 INTEGER32.

CiA 303-2: a unit is one UNSIGNED32 with the power of ten in its highest byte (two's complement), then numerator,
denominator and a reserved byte. Only units of force, torque and pressure are here. A cell that reports kilograms means
the weight of that mass at standard gravity.
"""

from dataclasses import dataclass

from hal.protocols.cia301 import MappedObject

INPUT_PROFILE = 401
"""Device profile number of generic input modules."""
CELL_PROFILE = 404
"""Device profile number of measuring devices."""

INTERRUPT_ENABLE = MappedObject(0x6423, 0, 8)
"""Global interrupt enable, a BOOLEAN that SDO carries in one byte."""
INPUTS = {
    "int16": MappedObject(0x6401, 0, 16, "signed"),
    "int32": MappedObject(0x6402, 0, 32, "signed"),
    "float32": MappedObject(0x6403, 0, 32, "float"),
}
"""Objects of an analogue input (CiA 401), without their channel."""

OFFSET = 0x6124
"""Object with the offset that a tare has set: REAL32, writable, in the unit of the process value."""
AUTOZERO = 0x6125
"""Object that tares a channel when `ZERO` is written to it."""
ZERO = int.from_bytes(b"zero", "little")
"""Signature that is written to 6125h."""
UNIT_CODE = 0x6131
"""Object with the unit code of the process value."""
DIGITS = 0x6132
"""Object with the number of decimal digits of a whole process value."""
STATUS = MappedObject(0x6150, 0, 8)
"""Object with the status of a channel, without the channel."""

INVALID = 0x01
OVERLOAD = 0x02
UNDERLOAD = 0x04


@dataclass(frozen=True, slots=True)
class ValueForm:
    """One form of a measured value in a CiA 404 device; the sub-index of its objects is the channel.

    Attributes:
        value: The object that is mapped.
        has_unit: Whether its unit is in 6131h; otherwise it is raw counts.
        has_digits: Whether it is a whole number of 10^-n units, where n is in 6132h.
        status: The object with its status, 0 if the value is good; None without a status.
    """

    value: MappedObject
    has_unit: bool = True
    has_digits: bool = False
    status: MappedObject | None = STATUS


FORMS = {
    "float32": ValueForm(MappedObject(0x6130, 0, 32, "float")),
    "int16": ValueForm(MappedObject(0x7130, 0, 16, "signed"), has_digits=True),
    "int32": ValueForm(MappedObject(0x9130, 0, 32, "signed"), has_digits=True),
    "counts16": ValueForm(MappedObject(0x7100, 0, 16, "signed"), has_unit=False),
    "counts32": ValueForm(MappedObject(0x9100, 0, 32, "signed"), has_unit=False),
}
"""The process value in three types, and the field value: the converter's counts before any scaling."""


def describe_status(status: int) -> str:
    """Return status bits in words; empty if the value is good."""
    bits = ((INVALID, "value not valid"), (OVERLOAD, "positive overload"), (UNDERLOAD, "negative overload"))
    known = [text for bit, text in bits if status & bit]
    other = status & ~(INVALID | OVERLOAD | UNDERLOAD)
    return ", ".join([*known, f"status {other:02X}h"] if other else known)


STANDARD_GRAVITY = 9.80665
"""Standard gravity [m/s2], by definition (3rd CGPM, 1901)."""


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit of measured values.

    Attributes:
        quantity: `force`, `torque` or `pressure`.
        scale: SI units in one of it.
    """

    quantity: str
    scale: float


_NUMERATORS = {
    0x02: Unit("force", STANDARD_GRAVITY),
    0x21: Unit("force", 1.0),
    0x22: Unit("pressure", 1.0),
}
"""Units by their numerator code: kilogram, newton, pascal."""
UNITS = {
    "N": Unit("force", 1.0),
    "mN": Unit("force", 1e-3),
    "kN": Unit("force", 1e3),
    "kg": Unit("force", STANDARD_GRAVITY),
    "g": Unit("force", 1e-3 * STANDARD_GRAVITY),
    "N m": Unit("torque", 1.0),
    "mN m": Unit("torque", 1e-3),
    "kN m": Unit("torque", 1e3),
    "Pa": Unit("pressure", 1.0),
    "kPa": Unit("pressure", 1e3),
    "MPa": Unit("pressure", 1e6),
    "mbar": Unit("pressure", 1e2),
    "bar": Unit("pressure", 1e5),
}
"""Units that a robot file may give for a device that does not report its unit, or reports a wrong one."""


def unit(code: int) -> Unit | None:
    """Return the unit of a code; None if it is not a known unit of force or pressure.

    00210000h is newton, 03210000h kilonewton, 00020000h kilogram, FD220000h millipascal.
    """
    exponent = (code >> 24 ^ 0x80) - 0x80
    base = _NUMERATORS.get(code >> 16 & 0xFF)
    if base is None or code & 0xFFFF or not -24 <= exponent <= 24:
        return None
    return Unit(base.quantity, base.scale * 10.0**exponent)
