"""Typed records <-> msgpack, with type, version, stamp and sequence in each.

On the wire a message is one msgpack map: `type`, `v`, `stamp_ns`, `seq`, `boot`, then the record's own fields. An array
of numbers is a msgpack binary of little-endian float64; an array of truth values is a binary of one byte each. What is
told of all signals is one array, in the order of the map `elements`, which says how many of them are whose.
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
"""What msgspec raises of bytes that are not msgpack, or not what they should be."""


class MessageError(ServiceError, ValueError):
    """Bytes that are not the message they should be; the text says what is wrong."""


class OtherVersion(MessageError):
    """A message of another version of the wire format."""


RECORDS: dict[str, type[Message]] = {
    record.TYPE: record for record in (Sample, Command, Holder, Applied, Estimates, Anomaly, Update, Target, Status)
}
M = TypeVar("M", bound=Message)
Decode = Callable[[bytes], Any]


def _packed(value: Any) -> Any:
    """What msgpack has no word for, in its words."""
    if isinstance(value, np.ndarray):
        return value.astype(_NUMBER, copy=False).tobytes()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"A message cannot carry {type(value).__name__}.")


def _read(_: Any, value: Any) -> np.ndarray:
    """The array of which `_packed` made this."""
    if type(value) is not bytes or len(value) % 8:
        raise ValueError("Expected a binary of little-endian float64")
    return np.frombuffer(value, _NUMBER)


_NUMBER = Numbers.DTYPE
_packed_before: dict[Elements, msgspec.Raw] = {}
"""Elements in their wire form, each packed once."""
_to_bytes = msgspec.msgpack.Encoder(enc_hook=_packed).encode
_readers: dict[type[Message], Decode] = {
    record: msgspec.msgpack.Decoder(record, dec_hook=_read).decode for record in RECORDS.values()
}
_read_any: Decode = msgspec.msgpack.Decoder(
    Union[tuple(RECORDS.values())],  # noqa: UP007 - made of a list
    dec_hook=_read,
).decode


def encode(message: Message, **header: int) -> bytes:
    """The wire form of a message; `header` replaces `seq` and `boot`, which the publisher knows."""
    whole: Any = message
    filled = whole.__copy__()  # `replace` would check it all again
    force_setattr(filled, "v", VERSION)
    for name in header:
        force_setattr(filled, name, header[name])
    if isinstance(filled, OfSignals):
        _flatten(filled)
    return _to_bytes(filled)


def _flatten(message: OfSignals) -> None:
    """Put what the wire has in place of what it stands for; quicker than a hook of msgspec for each."""
    elements = message.elements
    packed = _packed_before.get(elements)
    if packed is None:
        if len(_packed_before) >= KEPT:
            _packed_before.clear()
        packed = _packed_before[elements] = msgspec.Raw(_to_bytes(elements.counts))
    force_setattr(message, "elements", packed)
    for name, _, dtype, _ in message.parts:
        flat = getattr(message, name).flat
        if flat.dtype is not dtype:
            flat = flat.astype(dtype)
        force_setattr(message, name, flat.tobytes())


def decode(data: bytes, expected: type[M]) -> M:
    """Read a message of a known type.

    Raises:
        MessageError: Too long, not msgpack, another type, a field missing or of a wrong kind.
        OtherVersion: Of another version.
    """
    message: M = _decoded(data, _readers[expected], expected.TYPE)
    return message


def decode_any(data: bytes) -> Message:
    """Read a message of whatever type it says it is.

    Raises:
        MessageError: As `decode`, or the type is not known.
    """
    message: Message = _decoded(data, _read_any, None)
    return message


def _decoded(data: bytes, read: Decode, wanted: str | None) -> Any:
    if len(data) > MAX_BYTES:
        raise MessageError(f"A {wanted or 'gemuco'} message of {len(data)} bytes is over the limit of {MAX_BYTES}.")
    try:
        message = read(data)
    except UNREADABLE as error:
        raise _refusal(data, wanted, error) from None
    if message.v != VERSION:
        raise _other_version(message.TYPE, message.v)
    return message


def _refusal(data: bytes, wanted: str | None, error: Exception) -> MessageError:
    """Why bytes could not be read: what is most wrong with them, and no other fault that follows from it."""
    what = wanted or "gemuco"
    try:
        body = msgspec.msgpack.decode(data)
    except UNREADABLE as reason:
        return MessageError(f"A {what} message is not msgpack: {plain(str(reason))}.")
    if not isinstance(body, dict):
        return MessageError(f"Expected a {what} message, got {type(body).__name__}.")
    kind, version = body.get("type"), body.get("v")
    if not isinstance(kind, str) or kind != (wanted or kind):
        return MessageError(f"Expected a {what} message, got {shown(kind)}.")
    if kind not in RECORDS:
        return MessageError(f"There is no message type {shown(kind)}. Known types: {', '.join(RECORDS)}.")
    if type(version) is not int or version != VERSION:
        return _other_version(kind, version)
    return MessageError(f"A {kind} message is malformed: {plain(str(error))}.")


def _other_version(kind: str, version: Any) -> OtherVersion:
    return OtherVersion(f"A {kind} message has version {shown(version)}; this program reads {VERSION}.")
