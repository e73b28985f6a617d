"""Packets and registers of Dynamixel servos of the X series, protocol 2.0.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0" and the control tables of the X series (emanual.robotis.com).
"""

from collections.abc import Mapping, Sequence
from enum import IntEnum

from hal.protocols.serial_status import Status, StatusReader

NAME = "Dynamixel"
BROADCAST = 0xFE
HIGHEST_NODE = 0xFC
HEADER = b"\xff\xff\xfd\x00"
OVERHEAD = 11
"""A status packet has this number of bytes beside its data: header, id, length, instruction, error, checksum."""
MOST_LENGTH = 1024
"""A longer packet than this is noise that looks like a header."""
ALERT = 0x80
"""Bit of the error byte: the servo has a hardware error, which its register `HARDWARE_ERROR` names."""


class Instruction(IntEnum):
    """Instruction codes."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class Register(IntEnum):
    """Addresses of registers; those below 64 are kept without power, and only written without torque."""

    MODEL = 0
    FIRMWARE = 6
    RETURN_DELAY = 9
    DRIVE_MODE = 10
    MODE = 11
    HOMING_OFFSET = 20
    CURRENT_LIMIT = 38
    VELOCITY_LIMIT = 44
    HIGHEST_POSITION = 48
    LOWEST_POSITION = 52
    TORQUE_ENABLE = 64
    STATUS_LEVEL = 68
    HARDWARE_ERROR = 70
    WATCHDOG = 98
    GOAL_CURRENT = 102
    GOAL_VELOCITY = 104
    GOAL_POSITION = 116
    CURRENT = 126
    VELOCITY = 128
    POSITION = 132
    VOLTAGE = 144
    TEMPERATURE = 146


FEEDBACK = (Register.CURRENT, Register.TEMPERATURE + 1 - Register.CURRENT)
"""First register and number of bytes that are read in every cycle: from current to temperature."""
STATE = (Register.TORQUE_ENABLE, Register.WATCHDOG + 1 - Register.TORQUE_ENABLE)
"""First register and number of bytes that are read of one servo per cycle: from torque enable to watchdog. Both blocks
could be one through indirect addresses, but the e-Manual (208) and the maker's SDK (224) disagree on their place."""
COUNTS = 4096
"""Counts per turn."""
MIDDLE = 2048
"""Count in the middle of the single turn."""
VELOCITY_UNIT = 0.229
"""Velocities count in this unit [rpm]."""
LOAD_UNIT = 1e-3
"""Load, of models without a current sensor, counts in this share of the largest drive."""
VOLTAGE_UNIT = 0.1
"""Voltage counts in this unit [V]."""
WATCHDOG_UNIT = 0.02
"""The bus watchdog counts in this unit [s]."""
WATCHDOG_EXPIRED = 0xFF
"""The register of the bus watchdog reads so (-1) after it stopped the servo."""
MODES = {"position": 3, "velocity": 1, "effort": 0}
CURRENT_LIMITED_POSITION = 5
"""Mode in which the servo follows positions with at most the goal current."""
ERRORS = {
    0: "its supply voltage is out of range",
    2: "it is too hot",
    3: "its encoder fails",
    4: "its circuit had an electrical shock, or its supply is too weak for the motor",
    5: "it is overloaded",
}
"""Bit of the hardware error -> sentence."""


def crc(data: bytes | bytearray) -> int:
    """Return the CRC-16 (polynomial 8005h, start 0) of a packet up to its checksum."""
    value = 0
    for byte in data:
        value = (value << 8 ^ _CRC[(value >> 8 ^ byte) & 0xFF]) & 0xFFFF
    return value


def _crc_of(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = (value << 1 ^ (0x8005 if value & 0x8000 else 0)) & 0xFFFF
    return value


_CRC = tuple(_crc_of(byte) for byte in range(256))


def instruction(node: int, code: int, parameters: bytes = b"") -> bytes:
    """Return an instruction packet; FFh FFh FDh in it is followed by a stuffed FDh."""
    body = bytes((code,)) + parameters
    stuffed = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = HEADER + bytes((node,)) + (len(stuffed) + 2).to_bytes(2, "little") + stuffed
    return packet + crc(packet).to_bytes(2, "little")


def ping(node: int) -> bytes:
    """Return the packet that a servo answers with model number (2 bytes) and firmware (1 byte)."""
    return instruction(node, Instruction.PING)


def reboot(node: int) -> bytes:
    """Return the packet that restarts a servo, which alone ends a hardware error."""
    return instruction(node, Instruction.REBOOT)


def read(node: int, address: int, size: int) -> bytes:
    """Return the packet that reads registers of one servo."""
    return instruction(node, Instruction.READ, _place(address, size))


def write(node: int, address: int, data: bytes) -> bytes:
    """Return the packet that writes registers of one servo."""
    return instruction(node, Instruction.WRITE, address.to_bytes(2, "little") + data)


def sync_read(nodes: Sequence[int], address: int, size: int) -> bytes:
    """Return the packet that reads the same registers of several servos, which answer in this order."""
    return instruction(BROADCAST, Instruction.SYNC_READ, _place(address, size) + bytes(nodes))


def sync_write(address: int, data: Mapping[int, bytes]) -> bytes:
    """Return the packet that writes the same registers of several servos (node -> data of equal length)."""
    size = len(next(iter(data.values())))
    values = b"".join(bytes((node,)) + own for node, own in data.items())
    return instruction(BROADCAST, Instruction.SYNC_WRITE, _place(address, size) + values)


def _place(address: int, size: int) -> bytes:
    return address.to_bytes(2, "little") + size.to_bytes(2, "little")


def reader() -> StatusReader:
    """Return a parser of status packets, which skips the echo of instructions."""
    return StatusReader(_cut)


def _cut(waiting: bytearray) -> tuple[int, Status | None, bool]:
    start = waiting.find(HEADER)
    if start < 0:
        keep = next((size for size in (3, 2, 1) if waiting.endswith(HEADER[:size])), 0)
        return len(waiting) - keep, None, len(waiting) > keep
    if start:
        return start, None, True
    if len(waiting) < 7:
        return 0, None, False
    length = int.from_bytes(waiting[5:7], "little")
    if not 3 <= length <= MOST_LENGTH:
        return 1, None, True
    end = 7 + length
    if len(waiting) < end:
        return 0, None, False
    if crc(waiting[: end - 2]) != int.from_bytes(waiting[end - 2 : end], "little"):
        return 1, None, True
    body = bytes(waiting[7 : end - 2]).replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
    if body[0] != Instruction.STATUS:
        return end, None, False
    if len(body) < 2:
        return end, None, True
    return end, Status(waiting[4], body[1], body[2:]), False


def describe_error(error: int) -> str:
    """Return the causes in the register of hardware errors, as part of a sentence."""
    causes = [text for bit, text in ERRORS.items() if error >> bit & 1]
    return ", and ".join(causes) or f"error {error:02X}h"
