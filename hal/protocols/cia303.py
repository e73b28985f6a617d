"""Physical units as CANopen devices name them, and as a robot file does.

Source: CiA 303-2: one UNSIGNED32 with the power of ten in its highest byte (two's complement), then numerator,
denominator and a reserved byte. Only what a load cell or pressure sensor measures in is here. A cell that says kilogram
means the weight of that mass, at standard gravity.
"""

from dataclasses import dataclass

STANDARD_GRAVITY = 9.80665
"""[m/s2], by definition (3rd CGPM, 1901)."""


@dataclass(frozen=True, slots=True)
class Unit:
    """What a number of a device means.

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
"""Kilogram, newton, pascal."""

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
"""Units that a robot file may give for a device that does not, or wrongly, tell its own."""


def unit(code: int) -> Unit | None:
    """The unit that a code stands for; None if it is none of force or pressure.

    00210000h is newton, 03210000h kilonewton, 00020000h kilogram, FD220000h millipascal.
    """
    exponent = (code >> 24 ^ 0x80) - 0x80
    found = _NUMERATORS.get(code >> 16 & 0xFF)
    if found is None or code & 0xFFFF or not -24 <= exponent <= 24:
        return None
    return Unit(found.quantity, found.scale * 10.0**exponent)
