"""Encoding of ROS 2 messages: CDR, version 1, as DDS and rmw_zenoh use it.

A message is a mapping from field to value: a number, a text, another mapping, or a list or array of these. Bytes from
the network are never trusted: every length is checked against what is there.
"""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from services.errors import ServiceError
from services.ros2.definitions import Field, fields_of

LITTLE, BIG = b"\0\1\0\0", b"\0\0\0\0"
"""Each message begins with one of these headers; this module writes the first."""
_FORMATS = {
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float32": "f", "float64": "d", "bool": "B", "byte": "B",
}  # fmt: skip
_SIZES = {kind: struct.calcsize(letter) for kind, letter in _FORMATS.items()}
PADDING = 8
"""A message may end with at most this number of bytes [bytes] more than its fields."""


class BadBytes(ServiceError):
    """Bytes that are not a message of the expected type."""


def encode(name: str, message: Mapping[str, Any]) -> bytes:
    """Return the bytes of a message of the type `name`, with their header."""
    out = bytearray()
    _write(out, name, message)
    return LITTLE + bytes(out)


def decode(name: str, data: bytes) -> dict[str, Any]:
    """Return the message of the type `name` in these bytes; sequences of numbers are arrays, shape (n,).

    Raises:
        BadBytes: They are not exactly one such message.
    """
    if len(data) < 4 or data[:2] not in (LITTLE[:2], BIG[:2]):
        raise BadBytes(f"{len(data)} bytes are not a {name}: they have no CDR header.")
    reader = _Bytes(memoryview(data)[4:], "<" if data[:2] == LITTLE[:2] else ">")
    try:
        message = _read(reader, name)
    except (struct.error, ValueError, UnicodeDecodeError) as error:
        raise BadBytes(f"{len(data)} bytes are not a {name}: {error}.") from None
    if len(reader.data) - reader.place >= PADDING:
        raise BadBytes(f"{len(data)} bytes are not a {name}: {len(reader.data) - reader.place} bytes are left over.")
    return message


def _write(out: bytearray, name: str, message: Mapping[str, Any]) -> None:
    for field in fields_of(name):
        value = message[field.name]
        if field.repeated == "no":
            _write_item(out, field.kind, value)
            continue
        if field.repeated != "fixed":
            _write_item(out, "uint32", len(value))
        if field.kind in _FORMATS:
            if len(value):
                _align(out, _SIZES[field.kind])
                out += np.asarray(value).astype("<" + np.dtype(_FORMATS[field.kind]).str[1:]).tobytes()
        else:
            for item in value:
                _write_item(out, field.kind, item)


def _write_item(out: bytearray, kind: str, value: Any) -> None:
    if kind in _FORMATS:
        _align(out, _SIZES[kind])
        out += struct.pack("<" + _FORMATS[kind], value)
    elif kind == "string":
        text = value.encode() + b"\0"
        _write_item(out, "uint32", len(text))
        out += text
    else:
        _write(out, kind, value)


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)


class _Bytes:
    """Bytes after the header, and the place of the next one."""

    def __init__(self, data: memoryview, order: str) -> None:
        self.data, self.order, self.place = data, order, 0

    def number(self, kind: str) -> Any:
        """Return the next number of a primitive type."""
        self.align(_SIZES[kind])
        (value,) = struct.unpack_from(self.order + _FORMATS[kind], self.data, self.place)
        self.place += _SIZES[kind]
        return value

    def take(self, size: int) -> memoryview:
        """Return the next `size` bytes."""
        if size > len(self.data) - self.place:
            raise ValueError(f"{size} bytes are announced where {len(self.data) - self.place} are left")
        part = self.data[self.place : self.place + size]
        self.place += size
        return part

    def align(self, size: int) -> None:
        """Skip the padding before a number of this size [bytes]."""
        self.place += -self.place % size

    def text(self) -> str:
        """Return the next text."""
        return bytes(self.take(self.number("uint32"))).rstrip(b"\0").decode()

    def numbers(self, kind: str, count: int) -> np.ndarray:
        """Return the next `count` numbers of a primitive type, shape (count,)."""
        if count:
            self.align(_SIZES[kind])
        return np.frombuffer(self.take(count * _SIZES[kind]), self.order + np.dtype(_FORMATS[kind]).str[1:])


def _read(reader: _Bytes, name: str) -> dict[str, Any]:
    return {field.name: _read_field(reader, field) for field in fields_of(name)}


def _read_field(reader: _Bytes, field: Field) -> Any:
    if field.repeated == "no":
        return _read_item(reader, field.kind)
    count = field.capacity if field.repeated == "fixed" else reader.number("uint32")
    if field.kind in _FORMATS:
        return reader.numbers(field.kind, count)
    if count > len(reader.data) - reader.place:  # an item has at least one byte
        raise ValueError(f"{count} items are announced where {len(reader.data) - reader.place} bytes are left")
    return [_read_item(reader, field.kind) for _ in range(count)]


def _read_item(reader: _Bytes, kind: str) -> Any:
    if kind in _FORMATS:
        return reader.number(kind)
    return reader.text() if kind == "string" else _read(reader, kind)
