"""Packets and registers of Feetech servos of the STS and SMS series.

Source: Feetech, "Communication Protocol User Manual" of the SCS protocol and memory table of the STS series
(doc.feetech.cn, FT-SMS-STS-emanual). Numbers of two bytes have the low byte first; the SCS series, which has the high
byte first and other registers, is not supported. A negative number has its sign in a bit of its own.
"""

from collections.abc import Mapping, Sequence
from enum import IntEnum

from hal.protocols.serial_status import Status, StatusReader

NAME = "Feetech"
BROADCAST = 0xFE
HIGHEST_NODE = 0xFD
HEADER = b"\xff\xff"
OVERHEAD = 6
"""A status packet has this number of bytes beside its data: header, id, length, error, checksum."""


class Instruction(IntEnum):
    """Instruction codes."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class Register(IntEnum):
    """Addresses of registers; those below 40 are kept without power, and locked by `LOCK`."""

    FIRMWARE = 0
    MODEL = 3
    RETURN_DELAY = 7
    STATUS_LEVEL = 8
    LOWEST_ANGLE = 9
    HIGHEST_ANGLE = 11
    OFFSET = 31
    MODE = 33
    TORQUE_ENABLE = 40
    ACCELERATION = 41
    GOAL_POSITION = 42
    GOAL_SPEED = 46
    TORQUE_LIMIT = 48
    LOCK = 55
    POSITION = 56
    SPEED = 58
    LOAD = 60
    VOLTAGE = 62
    TEMPERATURE = 63
    STATUS = 65
    CURRENT = 69


FEEDBACK = (Register.TORQUE_ENABLE, Register.CURRENT + 2 - Register.TORQUE_ENABLE)
"""First register and number of bytes that are read in every cycle: from torque enable to current."""
COUNTS = 4096
"""Counts per turn."""
MIDDLE = 2048
"""Count in the middle of the single turn."""
WORD_SIGN, LOAD_SIGN = 15, 10
"""Bit that is the sign of a position, speed or current, and of a load."""
LOAD_UNIT = 1e-3
"""Load counts in this share of the largest drive."""
CURRENT_UNIT = 6.5e-3
"""Current counts in this unit [A]."""
VOLTAGE_UNIT = 0.1
"""Voltage counts in this unit [V]."""
LARGEST_WORD = 0x7FFF
MODES = {"position": 0, "velocity": 1}
MODELS = {777: "STS3215", 2825: "STS3250", 11272: "SM8512BL"}
"""Model number -> name; others answer in the same way."""
BIG_ENDIAN = {1284: "SCS0009", 1029: "SCS15"}
"""Model numbers, read low byte first, of servos of the SCS series."""
ERRORS = {
    0: "its supply voltage is out of range",
    1: "its angle sensor fails",
    2: "it is too hot",
    3: "its current is too high",
    5: "it is overloaded",
}
"""Bit of the error byte -> sentence."""


def instruction(node: int, code: int, parameters: bytes = b"") -> bytes:
    """Return an instruction packet."""
    body = bytes((node, len(parameters) + 2, code)) + parameters
    return HEADER + body + bytes((checksum(body),))


def checksum(body: bytes | bytearray) -> int:
    """Return the inverted sum of the bytes between header and checksum."""
    return ~sum(body) & 0xFF


def ping(node: int) -> bytes:
    """Return the packet that a servo answers without data."""
    return instruction(node, Instruction.PING)


def read(node: int, address: int, size: int) -> bytes:
    """Return the packet that reads registers of one servo."""
    return instruction(node, Instruction.READ, bytes((address, size)))


def write(node: int, address: int, data: bytes) -> bytes:
    """Return the packet that writes registers of one servo."""
    return instruction(node, Instruction.WRITE, bytes((address,)) + data)


def sync_read(nodes: Sequence[int], address: int, size: int) -> bytes:
    """Return the packet that reads the same registers of several servos, which answer in this order."""
    return instruction(BROADCAST, Instruction.SYNC_READ, bytes((address, size, *nodes)))


def sync_write(address: int, data: Mapping[int, bytes]) -> bytes:
    """Return the packet that writes the same registers of several servos (node -> data of equal length)."""
    size = len(next(iter(data.values())))
    values = b"".join(bytes((node,)) + own for node, own in data.items())
    return instruction(BROADCAST, Instruction.SYNC_WRITE, bytes((address, size)) + values)


def reader() -> StatusReader:
    """Return a parser of status packets."""
    return StatusReader(_cut)


def _cut(waiting: bytearray) -> tuple[int, Status | None, bool]:
    start = waiting.find(HEADER)
    if start < 0:
        keep = 1 if waiting[-1] == 0xFF else 0
        return len(waiting) - keep, None, len(waiting) > keep
    if start:
        return start, None, True
    if len(waiting) < 4:
        return 0, None, False
    node, length = waiting[2], waiting[3]
    if node > HIGHEST_NODE or length < 2:
        return 1, None, node != 0xFF  # a third FFh is noise before a header
    end = 4 + length
    if len(waiting) < end:
        return 0, None, False
    if checksum(waiting[2 : end - 1]) != waiting[end - 1]:
        return 2, None, True
    return end, Status(node, waiting[4], bytes(waiting[5 : end - 1])), False


def word(value: int) -> bytes:
    """Return a number as two bytes, low byte first, with its sign in bit 15; too large ones are cut off."""
    size = min(abs(value), LARGEST_WORD)
    return (size | (0x8000 if value < 0 else 0)).to_bytes(2, "little")


def number(data: bytes, sign: int = WORD_SIGN) -> int:
    """Return two bytes as a number whose sign is in bit `sign`."""
    raw = int.from_bytes(data[:2], "little")
    size = raw & ((1 << sign) - 1)
    return -size if raw >> sign & 1 else size


def describe_error(error: int) -> str:
    """Return the causes in an error byte, as part of a sentence."""
    causes = [text for bit, text in ERRORS.items() if error >> bit & 1]
    return ", and ".join(causes) or f"error {error:02X}h"
