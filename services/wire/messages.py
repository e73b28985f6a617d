"""Typed records <-> msgpack, with type, version, stamp and sequence in each.

On the wire a message is one msgpack map: `type`, `v`, `stamp_ns`, `seq`, `boot`, then the record's own fields. An array
of numbers is a msgpack binary of little-endian float64; an array of truth values is a binary of one byte each. What is
told of all signals is one array, in the order of the map `elements`, which says how many of them are whose.
"""

import copy
from typing import Any, TypeVar, Union

import msgspec
import numpy as np
from msgspec.structs import force_setattr

from hal.by_signal import OPEN
from services.errors import ServiceError
from services.wire.plain_text import plain, shown
from services.wire.records import (
    Anomaly,
    Applied,
    Command,
    Elements,
    Estimates,
    Holder,
    Message,
    Numbers,
    Sample,
    Status,
    Target,
    Truths,
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


def _packed(value: Any) -> Any:
    """What msgpack has no word for, in its words."""
    kind = type(value)
    if kind is Numbers or kind is Truths:
        flat = value.flat
        return flat.tobytes() if flat.dtype is kind.DTYPE else flat.astype(kind.DTYPE).tobytes()
    if kind is Elements:
        return value.counts
    if isinstance(value, np.ndarray):
        return value.astype(_NUMBER, copy=False).tobytes()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"A message cannot carry {kind.__name__}.")


def _read(kind: Any, value: Any) -> Any:
    """What `_packed` made of something that is not msgpack's."""
    if kind is Numbers and type(value) is bytes and not len(value) % 8:
        return Numbers(np.frombuffer(value, _NUMBER), OPEN)
    if kind is Elements:
        if type(value) is not dict:
            raise ValueError("Expected a map from signal to its number of elements")
        return Elements.of(value)
    if kind is Truths:
        if type(value) is not bytes:
            raise ValueError("Expected a binary of bytes")
        is_plain = not value.strip(b"\0\1")
        return Truths(np.frombuffer(value, Truths.DTYPE) if is_plain else np.frombuffer(value, "u1") != 0, OPEN)
    if type(value) is not bytes or len(value) % 8:
        raise ValueError("Expected a binary of little-endian float64")
    return np.frombuffer(value, _NUMBER)


_NUMBER = Numbers.DTYPE
_encoder = msgspec.msgpack.Encoder(enc_hook=_packed)
_decoders: dict[type[Message], msgspec.msgpack.Decoder[Any]] = {
    record: msgspec.msgpack.Decoder(record, dec_hook=_read) for record in RECORDS.values()
}
_any_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(
    Union[tuple(RECORDS.values())],  # noqa: UP007 - made of a list
    dec_hook=_read,
)


def encode(message: Message, **header: int) -> bytes:
    """The wire form of a message; `header` replaces `seq` and `boot`, which the publisher knows."""
    filled = copy.copy(message)  # `replace` would check it all again
    force_setattr(filled, "v", VERSION)
    for name, value in header.items():
        force_setattr(filled, name, value)
    return _encoder.encode(filled)


def decode(data: bytes, expected: type[M]) -> M:
    """Read a message of a known type.

    Raises:
        MessageError: Too long, not msgpack, another type, a field missing or of a wrong kind.
        OtherVersion: Of another version.
    """
    message: M = _decoded(data, _decoders[expected], expected.TYPE)
    return message


def decode_any(data: bytes) -> Message:
    """Read a message of whatever type it says it is.

    Raises:
        MessageError: As `decode`, or the type is not known.
    """
    message: Message = _decoded(data, _any_decoder, None)
    return message


def _decoded(data: bytes, decoder: msgspec.msgpack.Decoder[Any], wanted: str | None) -> Any:
    if len(data) > MAX_BYTES:
        raise MessageError(f"A {wanted or 'gemuco'} message of {len(data)} bytes is over the limit of {MAX_BYTES}.")
    try:
        message = decoder.decode(data)
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
