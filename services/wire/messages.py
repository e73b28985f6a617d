"""Typed records <-> msgpack, with type, version, stamp and sequence in each.

On the wire a message is one msgpack map: `type`, `v`, `stamp_ns`, `seq`, `boot`, then the record's own fields. An array
of numbers is a msgpack binary of little-endian float64; an array of truth values is a binary of one byte each. A field
with values of all signals is one array. The map `elements` gives the order of the signals and the size of each.
"""

from collections.abc import Callable
from typing import Any, TypeVar, Union

import msgspec
import numpy as np
from msgspec.structs import force_setattr

from hal.by_signal import KEPT, Elements
from services.errors import ServiceError
from services.wire.plain_text import plain, shown
from services.wire.records import (
    Anomaly,
    Applied,
    Command,
    Estimates,
    Holder,
    Message,
    Numbers,
    OfSignals,
    Sample,
    Status,
    Target,
    Update,
)

__all__ = [
    "Anomaly", "Applied", "Command", "Estimates", "Holder", "Message", "MessageError", "Sample", "Status", "Target",
    "Update", "decode", "decode_any", "encode",
]  # fmt: skip

VERSION = 2
MAX_BYTES = 1 << 20
UNREADABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""msgspec raises these if bytes are not msgpack or not of the expected type."""


class MessageError(ServiceError, ValueError):
    """Malformed bytes, or a message of another type."""


class OtherVersion(MessageError):
    """A message of another version of the wire format."""


RECORDS: dict[str, type[Message]] = {
    record.TYPE: record for record in (Sample, Command, Holder, Applied, Estimates, Anomaly, Update, Target, Status)
}
M = TypeVar("M", bound=Message)
Decode = Callable[[bytes], Any]


def _packed(value: Any) -> Any:
    """Convert a value of numpy into a type of msgpack."""
    if isinstance(value, np.ndarray):
        return value.astype(_NUMBER, copy=False).tobytes()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"A message cannot carry {type(value).__name__}.")


def _read(_: Any, value: Any) -> np.ndarray:
    """Convert the binary that `_packed` made of an array back into the array."""
    if type(value) is not bytes or len(value) % 8:
        raise ValueError("Expected a binary of little-endian float64")
    return np.frombuffer(value, _NUMBER)


_NUMBER = Numbers.DTYPE
_packed_elements: dict[Elements, msgspec.Raw] = {}
"""This cache holds elements in their wire form."""
_to_bytes = msgspec.msgpack.Encoder(enc_hook=_packed).encode
_readers: dict[type[Message], Decode] = {
    record: msgspec.msgpack.Decoder(record, dec_hook=_read).decode for record in RECORDS.values()
}
_read_any: Decode = msgspec.msgpack.Decoder(
    Union[tuple(RECORDS.values())],  # noqa: UP007 - made of a list
    dec_hook=_read,
).decode


def encode(message: Message, **header: int) -> bytes:
    """Return the wire form of a message; `header` replaces `seq` and `boot`, which the publisher knows."""
    original: Any = message
    copy = original.__copy__()  # `replace` would check all fields again
    force_setattr(copy, "v", VERSION)
    for name in header:
        force_setattr(copy, name, header[name])
    if isinstance(copy, OfSignals):
        _flatten(copy)
    return _to_bytes(copy)


def _flatten(message: OfSignals) -> None:
    """Replace elements and arrays by their wire form, which is quicker than a hook of msgspec for each."""
    elements = message.elements
    packed = _packed_elements.get(elements)
    if packed is None:
        if len(_packed_elements) >= KEPT:
            _packed_elements.clear()
        packed = _packed_elements[elements] = msgspec.Raw(_to_bytes(elements.counts))
    force_setattr(message, "elements", packed)
    for name, _, dtype, _ in message.parts:
        flat = getattr(message, name).flat
        if flat.dtype is not dtype:
            flat = flat.astype(dtype)
        force_setattr(message, name, flat.tobytes())


def decode(data: bytes, expected: type[M]) -> M:
    """Read a message of a known type.

    Raises:
        MessageError: It is too long, not msgpack or of another type, or a field is missing or malformed.
        OtherVersion: It has another version.
    """
    message: M = _decoded(data, _readers[expected], expected.TYPE)
    return message


def decode_any(data: bytes) -> Message:
    """Read a message of any known type.

    Raises:
        MessageError: As `decode`, or the type is unknown.
    """
    message: Message = _decoded(data, _read_any, None)
    return message


def _decoded(data: bytes, read: Decode, expected: str | None) -> Any:
    if len(data) > MAX_BYTES:
        raise MessageError(f"A {expected or 'gemuco'} message of {len(data)} bytes is over the limit of {MAX_BYTES}.")
    try:
        message = read(data)
    except UNREADABLE as error:
        raise _refusal(data, expected, error) from None
    if message.v != VERSION:
        raise _other_version(message.TYPE, message.v)
    return message


def _refusal(data: bytes, expected: str | None, error: Exception) -> MessageError:
    """Return the error for bytes that could not be read: the first fault, without those that follow from it."""
    what = expected or "gemuco"
    try:
        body = msgspec.msgpack.decode(data)
    except UNREADABLE as reason:
        return MessageError(f"A {what} message is not msgpack: {plain(str(reason))}.")
    if not isinstance(body, dict):
        return MessageError(f"Expected a {what} message, got {type(body).__name__}.")
    kind, version = body.get("type"), body.get("v")
    if not isinstance(kind, str) or kind != (expected or kind):
        return MessageError(f"Expected a {what} message, got {shown(kind)}.")
    if kind not in RECORDS:
        return MessageError(f"There is no message type {shown(kind)}. Known types: {', '.join(RECORDS)}.")
    if type(version) is not int or version != VERSION:
        return _other_version(kind, version)
    return MessageError(f"A {kind} message is malformed: {plain(str(error))}.")


def _other_version(kind: str, version: Any) -> OtherVersion:
    return OtherVersion(f"A {kind} message has version {shown(version)}; this program reads {VERSION}.")
