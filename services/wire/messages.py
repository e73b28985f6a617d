"""Typed records <-> msgpack, with type, version, stamp and sequence in each.

On the wire a message is one msgpack map: `type`, `v`, `stamp_ns`, `seq`, `boot`, then the record's own fields. An array
of numbers is a msgpack binary of little-endian float64; an array of truth values is a binary of one byte each.
"""

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import msgpack
import numpy as np

from services.errors import ServiceError
from services.wire.plain_text import plain, shown
from services.wire.records import Anomaly, Applied, Command, Estimates, Holder, Message, Sample, Status, Target, Update

__all__ = [
    "Anomaly", "Applied", "Command", "Estimates", "Holder", "Message", "MessageError", "Sample", "Status", "Target",
    "Update", "decode", "decode_any", "encode",
]  # fmt: skip

VERSION = 1
MAX_BYTES = 1 << 20


class MessageError(ServiceError, ValueError):
    """Bytes that are not the message they should be; the text says what is wrong."""


class OtherVersion(MessageError):
    """A message of another version of the wire format."""


RECORDS: dict[str, type[Message]] = {
    record.TYPE: record for record in (Sample, Command, Holder, Applied, Estimates, Anomaly, Update, Target, Status)
}
M = TypeVar("M", bound=Message)
_fields: Callable[[Any], tuple[dataclasses.Field[Any], ...]] = functools.cache(dataclasses.fields)
_hints: Callable[[Any], dict[str, Any]] = functools.cache(typing.get_type_hints)
"""Resolving the annotations anew would cost more than all the rest of `decode`."""


def encode(message: Message, **header: int) -> bytes:
    """The wire form of a message; `header` replaces `seq` and `boot`, which the publisher knows."""
    body: dict[str, Any] = {"type": message.TYPE, "v": VERSION}
    for item in _fields(type(message)):
        body[item.name] = _pack(getattr(message, item.name))
    body.update(header)
    return msgpack.packb(body)


def _pack(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.astype("?" if value.dtype == bool else "<f8", copy=False).tobytes()
    if isinstance(value, dict):
        return {key: _pack(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_pack(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def decode(data: bytes, expected: type[M]) -> M:
    """Read a message of a known type.

    Raises:
        MessageError: Too long, not msgpack, another type, a field missing or of a wrong kind.
        OtherVersion: Of another version.
    """
    body = _body(data, expected.TYPE)
    if body.get("type") != expected.TYPE:
        raise MessageError(f"Expected a {expected.TYPE} message, got {shown(body.get('type'))}.")
    return _record(expected, body)


def decode_any(data: bytes) -> Message:
    """Read a message of whatever type it says it is.

    Raises:
        MessageError: As `decode`, or the type is not known.
    """
    body = _body(data, "gemuco")
    kind = body.get("type")
    if not isinstance(kind, str) or kind not in RECORDS:
        raise MessageError(f"There is no message type {shown(kind)}. Known types: {', '.join(RECORDS)}.")
    return _record(RECORDS[kind], body)


def _body(data: bytes, what: str) -> dict[str, Any]:
    if len(data) > MAX_BYTES:
        raise MessageError(f"A {what} message of {len(data)} bytes is over the limit of {MAX_BYTES}.")
    try:
        body = msgpack.unpackb(data)
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError(f"A {what} message is not msgpack: {error or type(error).__name__}.") from None
    if not isinstance(body, dict):
        raise MessageError(f"Expected a {what} message, got {type(body).__name__}.")
    return body


def _record(expected: type[M], body: dict[str, Any]) -> M:
    version = body.get("v")
    if type(version) is not int or version != VERSION:
        raise OtherVersion(f"A {expected.TYPE} message has version {shown(version)}; this program reads {VERSION}.")
    hints = _hints(expected)
    fields: dict[str, Any] = {}
    for item in _fields(expected):
        if item.name in body:
            fields[item.name] = _unpack(body[item.name], hints[item.name], f"{expected.TYPE}.{item.name}")
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise MessageError(f"A {expected.TYPE} message lacks '{item.name}'.")
    _check_alike(expected, fields)
    return expected(**fields)


def _check_alike(expected: type[Message], fields: Mapping[str, Any]) -> None:
    """Raise `MessageError` unless all that is told by signal is told of the same signals, with as many elements."""
    if not expected.PER_SIGNAL:
        return
    first, *others = expected.PER_SIGNAL
    sizes = {name: array.size for name, array in fields[first].items()}
    if not all(sizes.values()):
        raise MessageError(f"A {expected.TYPE} message has a signal without elements.")
    for other in others:
        found = fields[other]
        if found.keys() != sizes.keys():
            raise MessageError(f"A {expected.TYPE} message names other signals in '{other}' than in '{first}'.")
        for name, array in found.items():
            if isinstance(array, np.ndarray) and array.size != sizes[name]:
                raise MessageError(
                    f"A {expected.TYPE} message has {array.size} elements in '{other}.{plain(name, 60)}' and "
                    f"{sizes[name]} in '{first}'."
                )


def _unpack(value: Any, hint: Any, where: str) -> Any:
    if hint is np.ndarray:
        return _array(value, where, truth=where.endswith((".valid", ".estimated")))
    origin = typing.get_origin(hint)
    if origin is dict:
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            raise MessageError(f"{where} is not a map with names as keys.")
        inner = typing.get_args(hint)[1]
        if inner is np.ndarray:
            truth = where.endswith((".valid", ".estimated"))
            return {key: _array(item, f"{where}.{plain(key, 60)}", truth) for key, item in value.items()}
        return value if inner is Any else {k: _unpack(v, inner, f"{where}.{plain(k, 60)}") for k, v in value.items()}
    if origin is list:
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise MessageError(f"{where} is not a list of names.")
        return value
    wanted: Any = (int, float) if hint is float else (origin or hint)
    if (
        isinstance(wanted, types.GenericAlias)
        or not isinstance(value, wanted)
        or (isinstance(value, bool) and hint is not bool)
    ):
        raise MessageError(f"{where} is {type(value).__name__}, not {getattr(hint, '__name__', hint)}.")
    return float(value) if hint is float else value


def _array(value: Any, where: str, truth: bool) -> np.ndarray:
    if not isinstance(value, bytes) or (not truth and len(value) % 8):
        raise MessageError(f"{where} is not a binary of {'bytes' if truth else 'little-endian float64'}.")
    return np.frombuffer(value, "u1") != 0 if truth else np.frombuffer(value, "<f8")
