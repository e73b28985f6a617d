"""CANopen application layer: identifiers, NMT, heartbeat, emergency, PDO parameters.

Source: CiA 301, version 4.2: 7.2.8 (NMT), 7.2.7 (emergency), 7.2.2 (PDO), 7.3.3 (predefined connection set), 7.5.2
(objects 1000h to 1FFFh).
"""

import re
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

NMT = 0x000
SYNC = 0x080
EMERGENCY = 0x080
TPDO1 = 0x180
RPDO1 = 0x200
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700

SYNCHRONOUS = 1
"""A PDO with this transmission type is sent at every SYNC; with n up to 240, at every n-th."""
LAST_SYNCHRONOUS = 240
EVENT_DRIVEN = (254, 255)
"""PDOs with these transmission types do not wait for a SYNC; the event timer (sub-index 5) sends them."""
PDO_INVALID = 1 << 31
"""This bit of a PDO's COB-ID entry means that the PDO does not exist."""

DEVICE_TYPE = 0x1000
CONSUMER_HEARTBEAT = 0x1016
PRODUCER_HEARTBEAT = 0x1017
IDENTITY = 0x1018
RPDO_PARAMETERS = 0x1400
RPDO_MAPPING = 0x1600
TPDO_PARAMETERS = 0x1800
TPDO_MAPPING = 0x1A00
PDO_PER_DIRECTION = 4
"""The predefined connection set has identifiers for this number of PDOs per direction."""
PDO_SIZE = 8
"""A PDO carries at most this number of bytes."""
ERROR_BEHAVIOUR = 0x1029
"""Sub-index 1 of this object is the reaction of a node to a missing heartbeat."""
BECOME_PRE_OPERATIONAL = 0
"""With this value of 1029h:1 a node becomes pre-operational and takes no process data."""


class NmtCommand(IntEnum):
    """Commands of the NMT master to a node."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """States in the heartbeat of a node."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


@dataclass(frozen=True, slots=True)
class EmergencyMessage:
    """The content of an emergency object.

    Attributes:
        code: Error code; 0 means that all errors are gone.
        register: Error register, object 1001h.
        detail: Five manufacturer specific bytes.
    """

    code: int
    register: int
    detail: bytes


@dataclass(frozen=True, slots=True)
class MappedObject:
    """An object in a PDO: index, sub-index, size and type."""

    index: int
    subindex: int
    bits: int
    kind: Literal["unsigned", "signed", "float"] = "unsigned"

    @property
    def entry(self) -> int:
        """Value of a mapping parameter (UNSIGNED32)."""
        return self.index << 16 | self.subindex << 8 | self.bits

    @property
    def format(self) -> str:
        """Format character of `struct`; CANopen is little-endian (7.1.4)."""
        return _FORMATS[self.kind, self.bits]

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.subindex}"


_FORMATS = {
    ("unsigned", 8): "B",
    ("unsigned", 16): "H",
    ("unsigned", 32): "I",
    ("unsigned", 64): "Q",
    ("signed", 8): "b",
    ("signed", 16): "h",
    ("signed", 32): "i",
    ("signed", 64): "q",
    ("float", 32): "f",
    ("float", 64): "d",
}
_TYPES: dict[str, tuple[Literal["unsigned", "signed", "float"], int]] = {
    **{f"uint{bits}": ("unsigned", bits) for bits in (8, 16, 32, 64)},
    **{f"int{bits}": ("signed", bits) for bits in (8, 16, 32, 64)},
    **{f"float{bits}": ("float", bits) for bits in (32, 64)},
}
_PLACE = re.compile(r"(?:0x)?([0-9A-Fa-f]{4})h?(?::([0-9]{1,3}))?")
_EMERGENCY = struct.Struct("<HB5s")
_REGISTER = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "device profile",
    "reserved",
    "manufacturer",
)
"""Bits of the error register, object 1001h (CiA 301, 7.5.2.2)."""
_FAMILIES = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current, device input side",
    0x22: "current inside the device",
    0x23: "current, device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x70: "additional modules",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x84: "velocity",
    0x86: "position",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}
_CODES = {
    0x8110: "CAN overrun",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN identifier collision",
    0x8210: "PDO not processed: length error",
    0x8220: "PDO length exceeded",
    0x8611: "following error",
}


def nmt_command(command: NmtCommand, node: int) -> bytes:
    """Return the data of the NMT frame; node 0 means all nodes."""
    return bytes((command, node))


def nmt_state(data: bytes | bytearray) -> int | None:
    """Return the state in a heartbeat without the toggle bit of node guarding; None if the frame is not a heartbeat."""
    return data[0] & 0x7F if len(data) == 1 else None


def emergency(data: bytes | bytearray) -> EmergencyMessage | None:
    """Return the content of an emergency frame; None if the frame is not one."""
    return EmergencyMessage(*_EMERGENCY.unpack(data)) if len(data) == _EMERGENCY.size else None


def describe_emergency(code: int, register: int = 0, detail: bytes = b"") -> str:
    """Return an emergency in words, as `communication: life guard or heartbeat error (8130h)`.

    Error register and manufacturer specific bytes are added if they are not zero: `(register: generic, communication;
    manufacturer 01 00 00 00 00)`.
    """
    family = _FAMILIES.get(code >> 8) or _FAMILIES.get(code >> 8 & 0xF0, "unknown family")
    exact = _CODES.get(code)
    text = f"{family}: {exact} ({code:04X}h)" if exact else f"{family} ({code:04X}h)"
    bits = ", ".join(name for bit, name in enumerate(_REGISTER) if register >> bit & 1)
    more = [f"register: {bits}"] if bits else []
    more += [f"manufacturer {detail.hex(' ').upper()}"] if any(detail) else []
    return f"{text} ({'; '.join(more)})" if more else text


def mapped(place: str, kind: str) -> MappedObject:
    """Return the object `2200h:1` (or `2200h`, `0x2200:1`) with a type such as `int16`.

    Raises:
        ValueError: The text is not an object, or the type is unknown.
    """
    match = _PLACE.fullmatch(place.strip())
    if match is None or int(match[2] or 0) > 0xFF:
        raise ValueError(f"'{place}' is not an object such as 6064h or 2200h:1.")
    if kind not in _TYPES:
        raise ValueError(f"'{kind}' is not a type of an object. Known: {', '.join(_TYPES)}.")
    return MappedObject(int(match[1], 16), int(match[2] or 0), _TYPES[kind][1], _TYPES[kind][0])


def consumer_heartbeat(node: int, limit: float) -> int:
    """Return the entry of object 1016h: the monitored node, and the time limit [s] of its heartbeat."""
    return node << 16 | round(limit * 1000)
