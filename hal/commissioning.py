"""Bring a CANopen node into a known configuration, and check that it took it.

canopen's SDO client carries the requests; its matching of answers is not relied upon, since a late answer to one
request would be taken as the answer to the next (it compares the index when reading, and nothing when writing).
"""

import queue
import struct
import time
from dataclasses import dataclass, field

import can
import canopen
from canopen.objectdictionary import ODVariable

from hal.bus import OWN_NODE, Bus
from hal.errors import DeviceRefused, DeviceSilent, WrongDevice
from hal.protocols import cia301
from hal.protocols.cia301 import Mapped, NmtCommand

ANSWER_TIME = 0.3
"""How long [s] a node may take to answer a request."""
TRIES = 3
HEARTBEAT_TIME = 0.1
"""Period [s] of a node's heartbeat."""

_REQUEST = struct.Struct("<BHB4s")
_READ = 0x40
_ABORT = 0x80
_ABORTS = {
    0x0601_0000: "access is not supported",
    0x0601_0001: "it is write only",
    0x0601_0002: "it is read only",
    0x0602_0000: "there is no such object",
    0x0604_0041: "it cannot be mapped",
    0x0604_0042: "the mapping is too long",
    0x0607_0010: "its length is another",
    0x0609_0011: "there is no such sub-index",
    0x0609_0030: "the value is out of range",
    0x0800_0022: "not in this state of the device",
}


@dataclass(frozen=True, slots=True)
class Plan:
    """What a node shall be told.

    Attributes:
        profile: Device profile number, the low word of object 1000h.
        receives: Objects of RPDO1, in order; empty for none.
        sends: Objects of TPDO1, in order.
        writes: Further objects and the values to write to them before the node is started.
        watch_time: How long [s] the node waits for the HAL's heartbeat before it stops; 0 if it does not watch.
    """

    profile: int
    receives: tuple[Mapped, ...]
    sends: tuple[Mapped, ...]
    writes: tuple[tuple[Mapped, int], ...] = field(default=())
    watch_time: float = 0.0


class SdoClient:
    """Reads and writes small objects of one node; each answer is matched with its request."""

    def __init__(self, bus: Bus, node: int, dictionary: canopen.ObjectDictionary, label: str) -> None:
        self._remote = bus.network.add_node(canopen.RemoteNode(node, dictionary))
        self._label = label
        self._dictionary = dictionary
        self._bus = bus
        self._node = node
        self._listening = False
        bus.subscribe(cia301.SDO_ANSWER + node, self._on_answer)

    def _on_answer(self, data: bytearray, received: float) -> None:
        if self._listening and len(data) == 8:  # nobody asked: it would only fill canopen's queue
            self._bus.network.notify(cia301.SDO_ANSWER + self._node, data, received)

    def read(self, index: int, subindex: int, tries: int = TRIES) -> int:
        """An unsigned value of up to 32 bits.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: There is no such object, or it is longer.
        """
        answer = self._ask(_REQUEST.pack(_READ, index, subindex, bytes(4)), tries)
        if not answer[0] & 0x02:
            raise DeviceRefused(f"{self._label}: object {index:04X}h:{subindex} is longer than four bytes.")
        size = 4 - (answer[0] >> 2 & 3) if answer[0] & 0x01 else 4
        return int.from_bytes(answer[4 : 4 + size], "little")

    def write(self, index: int, subindex: int, value: int, size: int) -> None:
        """Write `value` in `size` bytes, two's complement if negative.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: The node does not take it.
        """
        data = value.to_bytes(size, "little", signed=value < 0).ljust(4, b"\0")
        self._ask(_REQUEST.pack(0x23 | (4 - size) << 2, index, subindex, data), TRIES)

    def write_checked(self, index: int, subindex: int, value: int, size: int) -> None:
        """Write, read back and compare.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: The node does not take it, or answers another value.
        """
        self.write(index, subindex, value, size)
        found = self.read(index, subindex)
        if found != value % (1 << 8 * size):
            raise DeviceRefused(
                f"{self._label}: object {index:04X}h:{subindex} reads back {found:X}h after writing {value:X}h. "
                "Is it writable in this firmware?"
            )

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the data sheet lists an object."""
        return self._dictionary.get_variable(index, subindex) is not None

    def default(self, index: int, subindex: int) -> int | None:
        """What the data sheet gives as an object's value; None if it gives none."""
        entry: ODVariable | None = self._dictionary.get_variable(index, subindex)
        return entry.default if entry is not None and isinstance(entry.default, int) else None

    def _ask(self, request: bytes, tries: int) -> bytes:
        sdo = self._remote.sdo
        self._listening = True
        try:
            for _ in range(tries):
                sdo.responses = queue.Queue()
                sdo.send_request(request)
                answer = self._matching(request)
                if answer is not None:
                    return answer
        finally:
            self._listening = False
        _, index, subindex, _ = _REQUEST.unpack(request)
        raise DeviceSilent(
            f"{self._label} did not answer within {ANSWER_TIME * 1e3:.0f} ms when asked for object "
            f"{index:04X}h:{subindex} ({tries} tries). Is it powered, is the bus terminated, is its node id right?"
        )

    def _matching(self, request: bytes) -> bytes | None:
        """The answer to a request, or None in time; answers to anything else are passed over."""
        deadline = time.monotonic() + ANSWER_TIME
        while (remaining := deadline - time.monotonic()) > 0:
            try:
                answer: bytes = self._remote.sdo.responses.get(timeout=remaining)
            except queue.Empty:
                return None
            if answer[1:4] != request[1:4]:
                continue
            if answer[0] == _ABORT:
                code = int.from_bytes(answer[4:8], "little")
                index, subindex = struct.unpack("<HB", answer[1:4])
                reason = _ABORTS.get(code, "see CiA 301, table 22")
                raise DeviceRefused(f"{self._label} refused object {index:04X}h:{subindex}: {code:08X}h, {reason}.")
            if (answer[0] & 0xE0 == 0x40) == (request[0] == _READ):
                return answer
        return None


def nmt(bus: Bus, command: NmtCommand, node: int) -> None:
    """Send an NMT command; nobody answers it, the node's heartbeat tells."""
    data = cia301.nmt_command(command, node)
    bus.send(can.Message(arbitration_id=cia301.NMT, is_extended_id=False, data=data))


def identify(sdo: SdoClient, plan: Plan, label: str) -> str:
    """Check that the node is what its data sheet says, and tell it from all others; one try, since nobody may be there.

    Returns:
        `canopen:<vendor>-<product>-<serial>` in hexadecimal digits.

    Raises:
        DeviceSilent: No answer.
        WrongDevice: Another profile, vendor or product.
    """
    device_type = sdo.read(cia301.DEVICE_TYPE, 0, tries=1)
    if device_type & 0xFFFF != plan.profile:
        raise WrongDevice(
            f"{label} has device profile {device_type & 0xFFFF}, not {plan.profile}. Are two node ids swapped?"
        )
    names = []
    for subindex, what in ((1, "vendor"), (2, "product"), (4, "serial number")):
        if not sdo.has(cia301.IDENTITY, subindex):
            names.append(0)
            continue
        expected = sdo.default(cia301.IDENTITY, subindex)
        found = sdo.read(cia301.IDENTITY, subindex)
        names.append(found)
        if expected and found != expected:
            raise WrongDevice(f"{label} has {what} {found:X}h, its EDS file says {expected:X}h. Is it the right file?")
    return "canopen:" + "-".join(f"{name:08X}" for name in names)


def commission(sdo: SdoClient, plan: Plan, node: int) -> None:
    """Write and read back PDO, heartbeats and settings of a node that is pre-operational.

    Raises:
        DeviceSilent: The node stopped answering.
        DeviceRefused: It does not take a value.
    """
    _silence_other_pdos(sdo, node)
    _map(sdo, cia301.RPDO_PARAMETERS, cia301.RPDO_MAPPING, cia301.RPDO1 + node, plan.receives)
    _map(sdo, cia301.TPDO_PARAMETERS, cia301.TPDO_MAPPING, cia301.TPDO1 + node, plan.sends)
    sdo.write_checked(cia301.PRODUCER_HEARTBEAT, 0, round(HEARTBEAT_TIME * 1000), 2)
    if plan.watch_time:
        watch_us(sdo, plan.watch_time)
    for item, value in plan.writes:
        sdo.write_checked(item.index, item.subindex, value, item.bits // 8)


def watch_us(sdo: SdoClient, limit: float) -> None:
    """Have the node stop when the HAL's heartbeat fails for `limit` [s]; 0 to end that.

    Raises:
        DeviceSilent: No answer.
        DeviceRefused: The node cannot.
    """
    sdo.write_checked(cia301.CONSUMER_HEARTBEAT, 1, cia301.consumer_heartbeat(OWN_NODE, limit) if limit else 0, 4)


def _map(sdo: SdoClient, parameters: int, mapping: int, cob_id: int, objects: tuple[Mapped, ...]) -> None:
    """Map the first PDO of a direction, in the order that CiA 301 (7.5.2.36) asks for: off, empty, fill, count, on."""
    if not objects:
        return
    sdo.write(parameters, 1, cia301.PDO_INVALID | cob_id, 4)
    sdo.write_checked(parameters, 2, cia301.SYNCHRONOUS, 1)
    sdo.write(mapping, 0, 0, 1)
    for place, item in enumerate(objects, 1):
        sdo.write_checked(mapping, place, item.entry, 4)
    sdo.write_checked(mapping, 0, len(objects), 1)
    sdo.write(parameters, 1, cob_id, 4)
    found = sdo.read(parameters, 1)
    if found & (cia301.PDO_INVALID | 0x7FF) != cob_id:
        raise DeviceRefused(f"PDO parameter {parameters:04X}h:1 reads back {found:08X}h after writing {cob_id:08X}h.")


def _silence_other_pdos(sdo: SdoClient, node: int) -> None:
    """Switch off what would load the bus unasked."""
    for number in range(1, cia301.PDO_PER_DIRECTION):
        for base, first in ((cia301.RPDO_PARAMETERS, cia301.RPDO1), (cia301.TPDO_PARAMETERS, cia301.TPDO1)):
            if sdo.has(base + number, 1):
                sdo.write(base + number, 1, cia301.PDO_INVALID | first + 0x100 * number + node, 4)
