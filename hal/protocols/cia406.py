"""Absolute encoders: position, speed, alarms, warnings, and counts per turn.

Source: CiA 406, version 3.2: 6000h to 6004h, 6030h, 6031h, 6501h to 6506h. The preset 6003h is never written: the zero
is in the robot file, so an encoder that loses its preset does not move the joint's zero.
"""

from hal.protocols.cia301 import MappedObject

PROFILE = 406

OPERATING_PARAMETERS = MappedObject(0x6000, 0, 16)
SCALING_ON = 1 << 2
"""This bit of 6000h selects the units of 6001h and 6002h for the position, else those of 6501h and 6502h."""
UNITS_PER_TURN = MappedObject(0x6001, 0, 32)
TOTAL_UNITS = MappedObject(0x6002, 0, 32)
POSITION = MappedObject(0x6004, 0, 32)
SPEED = MappedObject(0x6030, 1, 16, "signed")
"""Its unit is position units per second, unless 6031h defines another."""
SPEED_MULTIPLIER = MappedObject(0x6031, 3, 16)
SPEED_DIVIDER = MappedObject(0x6031, 4, 16)
PHYSICAL_PER_TURN = MappedObject(0x6501, 0, 32)
PHYSICAL_TURNS = MappedObject(0x6502, 0, 16)
ALARMS = MappedObject(0x6503, 0, 16)
WARNINGS = MappedObject(0x6505, 0, 16)

POSITION_ERROR = 0x0001
COMMISSIONING_DIAGNOSTIC = 0x0002
_ALARMS = ((POSITION_ERROR, "position error"), (COMMISSIONING_DIAGNOSTIC, "commissioning diagnostic failed"))
_WARNINGS = (
    (0x0001, "frequency exceeded"),
    (0x0002, "light control reserve reached"),
    (0x0004, "watchdog status not good"),
    (0x0008, "operating time limit exceeded"),
    (0x0010, "battery charge too low"),
    (0x0020, "reference point not reached"),
)


def describe_alarms(alarms: int) -> str:
    """Return alarm bits (6503h) in words; empty if there is none. With any alarm the position is invalid."""
    return _describe(alarms, _ALARMS, "alarms")


def describe_warnings(warnings: int) -> str:
    """Return warning bits (6505h) in words; empty if there is none. The position is still valid."""
    return _describe(warnings, _WARNINGS, "warnings")


def _describe(bits: int, names: tuple[tuple[int, str], ...], rest: str) -> str:
    words = [text for bit, text in names if bits & bit]
    other = bits & ~sum(bit for bit, _ in names)
    return ", ".join([*words, f"{rest} {other:04X}h"] if other else words)
