"""Access to small objects of one CANopen node (CiA 301, 7.2.4: expedited SDO).

The SDO client of canopen sends the requests. Its matching of answers is not used, since it takes a late answer as the
answer to the next request (it compares the index when reading, and nothing when writing).
"""

import queue
import struct
import threading
import time

import canopen
from canopen.objectdictionary import ODVariable

from hal.errors import DeviceRefused, DeviceSilent
from hal.protocols import cia301
from hal.protocols.sdo import describe_abort
from hal.wire.bus import Bus

ANSWER_TIME = 0.3
"""A node may take this time [s] to answer a request."""
TRIES = 3

_REQUEST = struct.Struct("<BHB4s")
_READ = 0x40
_ABORT = 0x80


class SdoClient:
    """Client that reads and writes small objects of one node, and matches each answer with its request."""

    def __init__(self, bus: Bus, node: int, dictionary: canopen.ObjectDictionary, label: str) -> None:
        self._remote = bus.network.add_node(canopen.RemoteNode(node, dictionary))
        self._label = label
        self._dictionary = dictionary
        self._bus = bus
        self._node = node
        self._listening = False
        self._lock = threading.Lock()
        bus.subscribe(cia301.SDO_ANSWER + node, self._on_answer)

    def _on_answer(self, data: bytearray, received: float) -> None:
        if self._listening and len(data) == 8:  # other answers would only fill the queue of canopen
            self._bus.network.notify(cia301.SDO_ANSWER + self._node, data, received)

    def read(self, index: int, subindex: int, tries: int = TRIES) -> int:
        """Return an unsigned value of up to 32 bits.

        Raises:
            DeviceSilent: The node does not answer.
            DeviceRefused: The object does not exist, or is longer.
        """
        answer = self._request(_REQUEST.pack(_READ, index, subindex, bytes(4)), tries)
        if not answer[0] & 0x02:
            raise DeviceRefused(f"{self._label}: object {index:04X}h:{subindex} is longer than four bytes.")
        size = 4 - (answer[0] >> 2 & 3) if answer[0] & 0x01 else 4
        return int.from_bytes(answer[4 : 4 + size], "little")

    def read_twice(self, index: int, subindex: int) -> int:
        """Return an unsigned value that two successive readings agree on, for numbers that give all others a meaning.

        Raises:
            DeviceSilent: The node does not answer.
            DeviceRefused: The object does not exist, is longer, or reads differently each time.
        """
        value = self.read(index, subindex)
        for _ in range(TRIES):
            before, value = value, self.read(index, subindex)
            if value == before:
                return value
        raise DeviceRefused(
            f"{self._label}: object {index:04X}h:{subindex} reads differently each time, last {value:X}h after "
            f"{before:X}h. Do two devices have this node id?"
        )

    def write(self, index: int, subindex: int, value: int, size: int) -> None:
        """Write `value` in `size` bytes, two's complement if negative.

        Raises:
            DeviceSilent: The node does not answer.
            DeviceRefused: The node refuses the value.
        """
        data = value.to_bytes(size, "little", signed=value < 0).ljust(4, b"\0")
        self._request(_REQUEST.pack(0x23 | (4 - size) << 2, index, subindex, data), TRIES)

    def write_checked(self, index: int, subindex: int, value: int, size: int) -> None:
        """Write, read back and compare.

        Raises:
            DeviceSilent: The node does not answer.
            DeviceRefused: The node refuses the value, or has another value after that.
        """
        self.write(index, subindex, value, size)
        actual = self.read(index, subindex)
        if actual != value % (1 << 8 * size):
            raise DeviceRefused(
                f"{self._label}: object {index:04X}h:{subindex} reads back {actual:X}h after writing {value:X}h. "
                "Is it writable in this firmware?"
            )

    def read_signed(self, index: int, subindex: int, bits: int) -> int:
        """Return a signed value of `bits` bits.

        Raises:
            DeviceSilent: The node does not answer.
            DeviceRefused: The object does not exist.
        """
        value = self.read(index, subindex) % (1 << bits)
        return value - (1 << bits) if value >> (bits - 1) else value

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the data sheet lists an object."""
        return self._dictionary.get_variable(index, subindex) is not None

    def can_write(self, index: int, subindex: int) -> bool:
        """Whether the data sheet lists an object that can be written."""
        entry: ODVariable | None = self._dictionary.get_variable(index, subindex)
        return entry is not None and "w" in entry.access_type

    def default(self, index: int, subindex: int) -> int | None:
        """Return the default of an object in the data sheet; None without one."""
        entry: ODVariable | None = self._dictionary.get_variable(index, subindex)
        return entry.default if entry is not None and isinstance(entry.default, int) else None

    def _request(self, request: bytes, tries: int) -> bytes:
        sdo = self._remote.sdo
        with self._lock:
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
        """Return the answer to a request, or None after `ANSWER_TIME`; ignore all other answers."""
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
                raise DeviceRefused(f"{self._label} refused object {index:04X}h:{subindex}: {describe_abort(code)}.")
            if (answer[0] & 0xE0 == 0x40) == (request[0] == _READ):
                return answer
        return None
