"""SDO transfers: requests, answers, reading of an object of any length, abort codes.

Source: CiA 301, version 4.2: 7.2.4 (SDO), table 22 (abort codes).
"""

import struct

HEAD = struct.Struct("<BHB")
"""Command, index, sub-index."""
LENGTH = 8
MOST_BYTES = 4096
"""A longer object is refused, because a node that never ends its segments must not fill the memory."""

UPLOAD = 2
"""The first answer of an upload has this value in its upper three bits."""
_ABORT = 4
_READ, _SEGMENT = 0x40, 0x60

ABORTS = {
    0x0503_0000: "the toggle bit did not alternate",
    0x0504_0000: "it took too long",
    0x0504_0001: "the command is not known",
    0x0504_0005: "out of memory",
    0x0601_0000: "access is not supported",
    0x0601_0001: "it is write only",
    0x0601_0002: "it is read only",
    0x0602_0000: "there is no such object",
    0x0604_0041: "it cannot be mapped",
    0x0604_0042: "the mapping is too long",
    0x0604_0043: "the parameters do not go together",
    0x0607_0010: "its length is another",
    0x0607_0012: "its length is too large",
    0x0607_0013: "its length is too small",
    0x0609_0011: "there is no such sub-index",
    0x0609_0030: "the value is out of range",
    0x0609_0031: "the value is too large",
    0x0609_0032: "the value is too small",
    0x0800_0000: "general error",
    0x0800_0020: "it cannot be transferred or stored",
    0x0800_0022: "not in this state of the device",
}


def describe_abort(code: int) -> str:
    """Return an abort code in words, as `06020000h, there is no such object`."""
    return f"{code:08X}h, {ABORTS.get(code, 'see CiA 301, table 22')}"


def expedited(data: bytes | bytearray) -> bytes:
    """Return the value in an expedited transfer of 8 bytes."""
    size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
    return bytes(data[4 : 4 + size])


class Upload:
    """The reading of one object, without I/O: send `request`, pass the answer to `answer`, and repeat until `is_done`.

    Attributes:
        request: Next request, 8 bytes; send it again if no answer comes.
        value: The object's bytes when they are complete, else None.
        refused: Reason of a refusal; empty without one.
    """

    def __init__(self, index: int, subindex: int) -> None:
        self.index, self.subindex = index, subindex
        self.value: bytes | None = None
        self.refused = ""
        self.request = HEAD.pack(_READ, index, subindex).ljust(LENGTH, b"\0")
        self._content = bytearray()
        self._toggle: int | None = None

    @property
    def is_done(self) -> bool:
        """Whether the reading has ended."""
        return self.value is not None or bool(self.refused)

    def answer(self, data: bytes | bytearray) -> bool:
        """Take an answer; ignore it and return False if it is not an answer to `request`."""
        if len(data) != LENGTH or self.is_done:
            return False
        command = data[0] >> 5
        is_of_object = struct.unpack_from("<HB", data, 1) == (self.index, self.subindex)
        if command == _ABORT and is_of_object:
            self.refused = describe_abort(int.from_bytes(data[4:], "little"))
            return True
        if self._toggle is None:
            return command == UPLOAD and is_of_object and self._begin(data)
        return command == 0 and data[0] >> 4 & 1 == self._toggle and self._take(data)

    def _begin(self, data: bytes | bytearray) -> bool:
        if data[0] & 2:
            self.value = expedited(data)
        else:
            self._toggle = 0
            self.request = bytes([_SEGMENT]).ljust(LENGTH, b"\0")
        return True

    def _take(self, data: bytes | bytearray) -> bool:
        self._content += data[1 : LENGTH - (data[0] >> 1 & 7)]
        if data[0] & 1:
            self.value = bytes(self._content)
        elif len(self._content) > MOST_BYTES:
            self.refused = f"it does not end after {MOST_BYTES} bytes"
        else:
            self._toggle = 1 - (self._toggle or 0)
            self.request = bytes([_SEGMENT | self._toggle << 4]).ljust(LENGTH, b"\0")
        return True
