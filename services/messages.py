"""Typed records <-> msgpack, with type, version, stamp and sequence in each.

On the wire a message is one msgpack map: `type`, `v`, `stamp_ns`, `seq`, `boot`, then the record's own fields. An array
of numbers is a msgpack binary of little-endian float64; an array of truth values is a binary of one byte each.
"""

import dataclasses
import functools
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

import msgpack
import numpy as np

from services.errors import ServiceError

VERSION = 1
MAX_BYTES = 1 << 20


class MessageError(ServiceError, ValueError):
    """Bytes that are not the message they should be; the text says what is wrong."""


Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """What every message carries.

    Attributes:
        stamp_ns: The sender's wall clock when the content was true [ns since 1970].
        seq: Counts up by one per message of this key and sender; a gap is a loss.
        boot: Random number of the sending process; another one means it was restarted.
    """

    TYPE: ClassVar[str]
    stamp_ns: int = 0
    seq: int = 0
    boot: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample(Message):
    """One coherent cycle of the robot's sensors, or one frame of a camera.

    Attributes:
        cycle: The HAL's cycle number, or the number of the frame.
        source: `can`, `camera`, `simulated` or `truth`.
        complete: Whether every device answered in this cycle.
        values: Signal -> values [the signal's unit], shape (n,); NaN where not valid.
        age: Signal -> age of each value when published [s], shape (n,); inf if never measured.
        valid: Signal -> whether each value may be used, shape (n,).
    """

    TYPE: ClassVar[str] = "sample"
    cycle: int
    source: str
    complete: bool
    values: Arrays
    age: Arrays
    valid: Arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Command(Message):
    """What is desired of the drives.

    Attributes:
        signal: The commanded signal.
        values: Desired values [its unit], shape (n,).
        cycle: `Sample.cycle` that the command answers; the HAL takes the command's age from it, on its own clock.
        hal_boot: `Sample.boot` of that sample.
    """

    TYPE: ClassVar[str] = "command"
    signal: str
    values: np.ndarray
    cycle: int
    hal_boot: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Applied(Message):
    """What was really sent to the drives in a cycle.

    Attributes:
        cycle: The HAL's cycle number.
        mode: `off`, `enabling`, `hold`, `follow`, `homing`, `stopping` or `fault`.
        signal: The commanded signal.
        desired: Newest accepted command [its unit], shape (n,); NaN if none is alive.
        values: Applied set-points [its unit], shape (n,); NaN while off.
        limited_by: Which limits acted (`acceleration`, `effort`, `range`, `rate`, `tension`, `velocity`), sorted.
        sender: `Command.boot` of the command that was followed; 0 if none.
    """

    TYPE: ClassVar[str] = "applied"
    cycle: int
    mode: str
    signal: str
    desired: np.ndarray
    values: np.ndarray
    limited_by: list[str]
    sender: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimates(Message):
    """Every signal of the body, measured where it can be and estimated where it cannot.

    Attributes:
        cycle: `Sample.cycle` it was made from; -1 without a fresh sample.
        values: Signal -> measured values, with estimates in place of the elements that are not valid [unit];
            NaN where neither is possible.
        estimated: Signal -> which elements were estimated, shape (n,).
        std: Signal -> expected error of an estimate (1 sigma) [unit], shape (n,); 0 where measured, NaN where unknown.
        method: Signal -> `measured`, `mask`, `latent`, `input` or `none`.
        mask: Signal -> the signals it was estimated from, joined by `+`.
        residual: Signal -> how badly the model explains what it was given, in standard deviations of the
            training data (root mean square); 0 where measured.
    """

    TYPE: ClassVar[str] = "estimates"
    cycle: int
    values: Arrays
    estimated: Arrays
    std: Arrays
    method: dict[str, str]
    mask: dict[str, str]
    residual: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Anomaly(Message):
    """How unlike normal the body is.

    Attributes:
        cycle: `Sample.cycle` it was made from.
        score: Mahalanobis distance (paper, II-K) of the prediction error; NaN without normal data.
        threshold: Score above which it counts as an anomaly.
        is_anomaly: Score above threshold for as long as the robot file asks, and not for a change of environment.
        blamed: `signal.element` that is most likely wrong over the samples above the threshold; below it, the one that
            contributes most.
        verdict: `normal`, `environment` (another condition of the body explains the samples above the threshold),
            `anomaly` (none does), or empty while there is nothing to judge.
        contribution: Signal -> each element's part of score^2, shape (n,).
    """

    TYPE: ClassVar[str] = "anomaly"
    cycle: int
    score: float
    threshold: float
    is_anomaly: bool
    blamed: str
    contribution: Arrays
    verdict: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Update(Message):
    """What the online update does.

    Attributes:
        active: Whether it is engaged.
        model_version: Counts up with every model that was swapped in.
        window: Samples in the bounded window.
        dropped: Oldest samples dropped so far.
        loss: Mean squared error over the window, in standard deviations of the training data.
        bias: The parametric bias p in use, shape (n,); empty without.
        settled: Whether p is well known, so that W may follow.
        rolled_back: How often W went back because it did worse on held-out samples.
    """

    TYPE: ClassVar[str] = "update"
    active: bool
    model_version: int
    window: int
    dropped: int
    loss: float
    bias: np.ndarray = field(default_factory=lambda: np.zeros(0))
    settled: bool = True
    rolled_back: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Target(Message):
    """Where the controller shall bring the body.

    Attributes:
        signal: Signal to reach, such as `joint_position`.
        values: Reference [its unit], shape (n,).
    """

    TYPE: ClassVar[str] = "target"
    signal: str
    values: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(Message):
    """Health of one service, once a second.

    Attributes:
        service: Which service.
        state: One word: `starting`, `ready`, `running`, `degraded`, `fault`, `stopping`.
        text: One sentence for a person; empty when all is well.
        loops: Loop name -> rate_wanted, rate [Hz], late_p50, late_p99, late_max [s], ticks, skipped.
        facts: Whatever else the service counts: devices, buses, controller, rejected messages.
    """

    TYPE: ClassVar[str] = "status"
    service: str
    state: str
    text: str = ""
    loops: dict[str, dict[str, float]] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)


RECORDS: dict[str, type[Message]] = {
    record.TYPE: record for record in (Sample, Command, Applied, Estimates, Anomaly, Update, Target, Status)
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
        MessageError: Too long, not msgpack, another type, another major version, a field missing or of a wrong kind.
    """
    body = _body(data, expected.TYPE)
    if body.get("type") != expected.TYPE:
        raise MessageError(f"Expected a {expected.TYPE} message, got {body.get('type')!r:.80}.")
    return _record(expected, body)


def decode_any(data: bytes) -> Message:
    """Read a message of whatever type it says it is.

    Raises:
        MessageError: As `decode`, or the type is not known.
    """
    body = _body(data, "gemuco")
    kind = body.get("type")
    if not isinstance(kind, str) or kind not in RECORDS:
        raise MessageError(f"There is no message type {kind!r:.80}. Known types: {', '.join(RECORDS)}.")
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
    if body.get("v") != VERSION:
        raise MessageError(
            f"A {expected.TYPE} message has version {body.get('v')!r:.80}; this program reads {VERSION}."
        )
    hints = _hints(expected)
    fields: dict[str, Any] = {}
    for item in _fields(expected):
        if item.name in body:
            fields[item.name] = _unpack(body[item.name], hints[item.name], f"{expected.TYPE}.{item.name}")
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise MessageError(f"A {expected.TYPE} message lacks '{item.name}'.")
    return expected(**fields)


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
            return {key: _array(item, f"{where}.{key}", truth) for key, item in value.items()}
        return value if inner is Any else {k: _unpack(v, inner, f"{where}.{k}") for k, v in value.items()}
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
    return np.frombuffer(value, dtype="?" if truth else "<f8")
