"""CANopen application layer: identifiers, NMT, heartbeat, emergency, PDO parameters.

Source: CiA 301, version 4.2: 7.2.8 (NMT), 7.2.7 (emergency), 7.2.2 (PDO), 7.3.3 (predefined connection set).
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

NMT = 0x000
SYNC = 0x080
EMERGENCY = 0x080
TPDO1 = 0x180
RPDO1 = 0x200
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700

SYNCHRONOUS = 1
"""Transmission type: at every SYNC."""
PDO_INVALID = 1 << 31
"""Bit of a PDO's COB-ID entry: the PDO does not exist."""

DEVICE_TYPE = 0x1000
CONSUMER_HEARTBEAT = 0x1016
PRODUCER_HEARTBEAT = 0x1017
IDENTITY = 0x1018
RPDO_PARAMETERS = 0x1400
RPDO_MAPPING = 0x1600
TPDO_PARAMETERS = 0x1800
TPDO_MAPPING = 0x1A00
PDO_PER_DIRECTION = 4
"""PDO that the predefined connection set gives an identifier per direction."""


class NmtCommand(IntEnum):
    """What the NMT master can ask of a node."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """What a node says of itself in its heartbeat."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


@dataclass(frozen=True, slots=True)
class Emergency:
    """What an emergency object says.

    Attributes:
        code: Error code; 0 means that all errors are gone.
        register: Error register, object 1001h.
        detail: Five bytes of the manufacturer's.
    """

    code: int
    register: int
    detail: bytes


@dataclass(frozen=True, slots=True)
class Mapped:
    """An object that a PDO carries: where it is in the object dictionary, and how many bits it has."""

    index: int
    subindex: int
    bits: int

    @property
    def entry(self) -> int:
        """The UNSIGNED32 of a mapping parameter."""
        return self.index << 16 | self.subindex << 8 | self.bits


_EMERGENCY = struct.Struct("<HB5s")
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
    """Data of the NMT frame; node 0 means all nodes."""
    return bytes((command, node))


def nmt_state(data: bytes | bytearray) -> int | None:
    """The state in a heartbeat, without the toggle bit of node guarding; None if the frame is not a heartbeat."""
    return data[0] & 0x7F if len(data) == 1 else None


def emergency(data: bytes | bytearray) -> Emergency | None:
    """What an emergency frame says; None if the frame is not one."""
    return Emergency(*_EMERGENCY.unpack(data)) if len(data) == _EMERGENCY.size else None


def describe_emergency(code: int) -> str:
    """An emergency error code in words, as `communication: life guard or heartbeat error (8130h)`."""
    family = _FAMILIES.get(code >> 8) or _FAMILIES.get(code >> 8 & 0xF0, "unknown family")
    exact = _CODES.get(code)
    return f"{family}: {exact} ({code:04X}h)" if exact else f"{family} ({code:04X}h)"


def consumer_heartbeat(node: int, limit: float) -> int:
    """Entry of object 1016h: node whose heartbeat is watched, and after how long [s] it counts as lost."""
    return node << 16 | round(limit * 1000)
