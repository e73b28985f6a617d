"""SDO server of a simulated node: expedited and segmented transfers (CiA 301, 7.2.4)."""

import struct
from dataclasses import dataclass

from simulators.nodes.canopen.objects import Abort, Key, ObjectDictionary, Refused

_HEAD = struct.Struct("<BHB")
_ABORT = struct.Struct("<BHBI")


@dataclass(slots=True)
class _Transfer:
    """A segmented transfer under way."""

    key: Key
    download: bool
    data: bytearray
    announced: int | None = None
    toggle: int = 0
    sent: int = 0


class SdoServer:
    """Answers one client at a time, as most devices do."""

    def __init__(self, objects: ObjectDictionary) -> None:
        self._objects = objects
        self._transfer: _Transfer | None = None

    def reset(self) -> None:
        """Forget a transfer under way."""
        self._transfer = None

    def answer(self, request: bytes) -> bytes | None:
        """Return the answer to one request of 8 bytes; None if there is none."""
        if len(request) != 8:
            return None
        command = request[0] >> 5
        if command == 4:  # the client gave up
            self._transfer = None
            return None
        index, sub = struct.unpack_from("<HB", request, 1)
        key = self._transfer.key if self._transfer and command in (0, 3) else (index, sub)
        try:
            if command == 0:
                return self._take_segment(request)
            if command == 1:
                return self._start_download(key, request)
            if command == 2:
                return self._start_upload(key)
            if command == 3:
                return self._give_segment(request)
            raise Refused(Abort.COMMAND)
        except Refused as refusal:
            self._transfer = None
            return _ABORT.pack(0x80, *key, refusal.code)

    def _start_download(self, key: Key, request: bytes) -> bytes:
        self._transfer = None
        expedited, sized = request[0] & 2, request[0] & 1
        if expedited:
            size = 4 - (request[0] >> 2 & 3) if sized else min(self._objects.entry(key).size or 4, 4)
            self._objects.write(key, bytes(request[4 : 4 + size]))
        else:
            entry = self._objects.entry(key)
            if entry.access in ("ro", "const"):
                raise Refused(Abort.READ_ONLY)
            announced = struct.unpack_from("<I", request, 4)[0] if sized else None
            self._transfer = _Transfer(key, True, bytearray(), announced)
        return _HEAD.pack(0x60, *key).ljust(8, b"\0")

    def _take_segment(self, request: bytes) -> bytes:
        transfer = self._at_toggle(request, download=True)
        transfer.data += request[1 : 8 - (request[0] >> 1 & 7)]
        if len(transfer.data) > 4096:
            raise Refused(Abort.MEMORY)
        reply = bytes([0x20 | transfer.toggle << 4]).ljust(8, b"\0")
        transfer.toggle ^= 1
        if request[0] & 1:
            if transfer.announced is not None and transfer.announced != len(transfer.data):
                raise Refused(Abort.LENGTH)
            self._objects.write(transfer.key, bytes(transfer.data))
            self._transfer = None
        return reply

    def _start_upload(self, key: Key) -> bytes:
        self._transfer = None
        data = self._objects.read(key)
        if 0 < len(data) <= 4:
            return _HEAD.pack(0x43 | 4 - len(data) << 2, *key) + data.ljust(4, b"\0")
        self._transfer = _Transfer(key, False, bytearray(data))
        return _HEAD.pack(0x41, *key) + struct.pack("<I", len(data))

    def _give_segment(self, request: bytes) -> bytes:
        transfer = self._at_toggle(request, download=False)
        part = transfer.data[transfer.sent : transfer.sent + 7]
        transfer.sent += len(part)
        is_last = transfer.sent >= len(transfer.data)
        reply = bytes([transfer.toggle << 4 | 7 - len(part) << 1 | is_last]) + bytes(part).ljust(7, b"\0")
        transfer.toggle ^= 1
        if is_last:
            self._transfer = None
        return reply

    def _at_toggle(self, request: bytes, download: bool) -> _Transfer:
        transfer = self._transfer
        if transfer is None or transfer.download != download:
            raise Refused(Abort.COMMAND)
        if request[0] >> 4 & 1 != transfer.toggle:
            raise Refused(Abort.TOGGLE)
        return transfer
