"""DBC files: messages and signals by name, compiled so that a cycle can read and write them fast.

A message whose signals lie on whole bytes is read by `struct`, one with whole numbers elsewhere by shift and mask, any
other, such as a multiplexed one, by cantools (studies/bus/dbc.py). A raw value is the number in the frame, before the
file's factor and offset.
"""

import difflib
import functools
import math
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import cantools
from cantools.database import Database, Message
from cantools.database.can.signal import Signal

from hal.errors import ConfigError
from hal.protocols.can_frames import LONGEST, LONGEST_FD, fd_size
from hal.protocols.dbc_text import decoded, mended

Value = float | str
"""A number in the unit of the DBC file, or the file's name of a raw value (VAL_)."""
Read = Callable[[bytes | bytearray], tuple[float, ...] | None]
Unpack = Callable[[bytes | bytearray], tuple[int, ...]]
LISTED = 40
"""An error lists at most this number of names."""

_INTEGERS = {8: "b", 16: "h", 32: "i", 64: "q"}
_FLOATS = {16: "e", 32: "f", 64: "d"}
_LARGEST_FLOATS = {16: 65504.0, 32: 3.4e38}
"""Values that fit into a float of this number of bits; a larger one could not be packed."""


class Dbc:
    """A DBC file. An unknown name is a `ConfigError` that lists the known ones.

    Attributes:
        path: The file.
        messages: Its messages.
        left_out: Name of a message that cannot be used -> why: it is longer than a frame, or its signals overlap or do
            not fit.
    """

    def __init__(self, path: Path, database: Database) -> None:
        self.path = path
        self.left_out = {
            message.name: wrong for message in database.messages if (wrong := _fault_of(message, database))
        }
        self.messages = tuple(message for message in database.messages if message.name not in self.left_out)
        self._messages = {message.name: message for message in self.messages}

    def message(self, name: str) -> Message:
        """Return a message.

        Raises:
            ConfigError: There is no message of that name.
        """
        if name in self.left_out:
            raise ConfigError(f"Message '{name}' of DBC file '{self.path}' cannot be used: {self.left_out[name]}")
        if name not in self._messages:
            raise ConfigError(f"DBC file '{self.path}' has no message '{name}'. {_suggest(name, self._messages)}")
        return self._messages[name]

    def signal(self, name: str) -> tuple[Message, Signal]:
        """Return the message and the signal of `Message.Signal`.

        Raises:
            ConfigError: The name has another form, or there is no such message or signal.
        """
        message_name, dot, signal_name = name.partition(".")
        if not dot:
            raise ConfigError(f"'{name}' does not have the form `Message.Signal`, with names of '{self.path}'.")
        message = self.message(message_name)
        return message, self.signal_of(message, signal_name)

    def signal_of(self, message: Message, name: str) -> Signal:
        """Return a signal of a message.

        Raises:
            ConfigError: The message has no signal of that name.
        """
        signals = {signal.name: signal for signal in message.signals}
        if name not in signals:
            raise ConfigError(
                f"Message '{message.name}' of DBC file '{self.path}' has no signal '{name}'. {_suggest(name, signals)}"
            )
        return signals[name]

    def raw(self, signal: Signal, value: Value) -> float:
        """Return the raw value of `value`; a whole number unless the signal is a float.

        Raises:
            ConfigError: The file has no value of that name, or the value does not fit into the signal.
        """
        if isinstance(value, str):
            named = {str(choice): raw for raw, choice in (signal.choices or {}).items()}
            if value not in named:
                raise ConfigError(
                    f"Signal '{signal.name}' of '{self.path}' has no value '{value}'. {_suggest(value, named)}"
                )
            return named[value]
        raw = (value - signal.offset) / signal.scale
        low, high = raw_bounds(signal)
        if not signal.is_float:
            raw = round(raw)
        if not low <= raw <= high:
            raise ConfigError(f"{value:g} does not fit into signal '{signal.name}' of '{self.path}'.")
        return raw


@functools.lru_cache(maxsize=32)
def load(path: Path) -> Dbc:
    """Read a DBC file, once per file.

    Files of vendors have messages that contradict themselves. Only these are left out. Slips that change no value are
    mended (`hal.protocols.dbc_text`).

    Raises:
        ConfigError: It is missing or not a DBC file.
    """
    if not path.is_file():
        raise ConfigError(f"There is no DBC file '{path}'. The path is relative to the folder of the robot file.")
    try:
        text = mended(decoded(path.read_bytes()))
        database = cantools.database.load_string(text, database_format="dbc", strict=False)
    except Exception as error:  # cantools passes on every exception of its parser
        raise ConfigError(f"'{path}' is not a DBC file that cantools can read: {error}.") from error
    assert isinstance(database, Database)
    return Dbc(path, database)


def _fault_of(message: Message, database: Database) -> str:
    """Return why a message cannot be used; empty if it can."""
    if message.length > LONGEST and not message.is_fd:
        size, specifics = f"It has {message.length} bytes", database.dbc
        attributes = specifics.attributes if specifics is not None else {}
        protocol = attributes["ProtocolType"].value if "ProtocolType" in attributes else message.protocol
        if str(protocol).upper() == "J1939":
            return f"{size}, so it comes in several frames by the transport protocol of J1939, which is not supported."
        if specifics is not None and "VFrameFormat" in specifics.attribute_definitions:
            return f"{size}, and a frame that is not of CAN FD by its VFrameFormat has at most {LONGEST}."
    if message.length > LONGEST_FD:
        return f"It has {message.length} bytes; a frame of CAN FD has at most {LONGEST_FD}."
    try:
        message.refresh(strict=True)
    except cantools.Error as error:
        return str(error)
    return ""


def is_fd(message: Message) -> bool:
    """Whether the frames of a usable message are of CAN FD: by VFrameFormat, or without that by its length."""
    return bool(message.is_fd) or message.length > LONGEST


def size_of(message: Message) -> int:
    """Return the data bytes of the frames of a message; one of CAN FD may have more than its signals need."""
    return fd_size(message.length) if is_fd(message) else message.length


def describe(signal: Signal, raw: float, is_bits: bool = False) -> str:
    """Return the file's name of a raw value, in lower case; for a bit field the names of all bits that are set."""
    choices = {value: str(choice).replace("_", " ").lower() for value, choice in (signal.choices or {}).items()}
    if raw in choices or not is_bits:
        return choices.get(int(raw), f"{raw:g}") if math.isfinite(raw) else "unknown"
    bits = [1 << bit for bit in range(signal.length) if int(raw) >> bit & 1]
    return ", ".join(choices.get(bit, f"bit {bit.bit_length() - 1}") for bit in bits)


def raw_bounds(signal: Signal) -> tuple[float, float]:
    """Return the smallest and the largest raw value that the signal can hold and the file allows."""
    if signal.is_float:
        high = _LARGEST_FLOATS.get(signal.length, math.inf)
        low = -high
    else:
        low, high = (
            (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
            if signal.is_signed
            else (0, (1 << signal.length) - 1)
        )
    stated = [(bound - signal.offset) / signal.scale for bound in (signal.minimum, signal.maximum) if bound is not None]
    return (max(low, min(stated)), min(high, max(stated))) if len(stated) == 2 else (low, high)


class SignalReader:
    """Reads signals from a message's data.

    Attributes:
        message: The message.
        names: The signals, in the order in which `read` returns them.
        size: Data bytes of its frames.
        is_compiled: Whether it is read without cantools.
        read: Data of `size` bytes -> raw values; NaN for a signal on another page of a multiplexed message; None if
            cantools cannot decode the data by the file.
    """

    def __init__(self, message: Message, names: Iterable[str]) -> None:
        selection = set(names)
        signals = sorted((s for s in message.signals if s.name in selection), key=_first_byte)
        self.message = message
        self.names = tuple(signal.name for signal in signals)
        self.size = size_of(message)
        layout = _layout(message, signals)
        fast = layout.unpack if layout is not None else _shifts(message, signals)
        self.is_compiled = fast is not None
        self.read: Read = fast or self._decode

    def _decode(self, data: bytes | bytearray) -> tuple[float, ...] | None:
        try:
            values: Any = self.message.decode(bytes(data), decode_choices=False, scaling=False)
        except cantools.Error:
            return None
        return tuple(values.get(name, math.nan) for name in self.names)


class Writer:
    """Makes a message's data: constant signals, and one that changes from cycle to cycle.

    Attributes:
        data: The data, with the newest raw value.
        bounds: Smallest and largest raw value of the varying signal.
    """

    def __init__(self, dbc: Dbc, message: Message, values: Mapping[str, Value], varying: str | None = None) -> None:
        """Give signals without a value the file's start value, or else raw 0.

        Raises:
            ConfigError: The message does not have such a signal or value.
        """
        self._message = message
        self._raws: dict[str, float] = {}
        for signal in message.signals:
            self._raws[signal.name] = signal.raw_initial if isinstance(signal.raw_initial, int | float) else 0
        for name, value in values.items():
            self._raws[name] = dbc.raw(dbc.signal_of(message, name), value)
        self._varying = varying
        self._packed: tuple[struct.Struct, int] | None = None
        self._is_whole = False
        if varying is not None:
            signal = dbc.signal_of(message, varying)
            self._is_whole = not signal.is_float
            self.bounds = raw_bounds(signal)
            code = _code(signal)
            if code is not None and signal.multiplexer_ids is None:
                self._packed = struct.Struct(_order(signal) + code), _first_byte(signal)
        try:
            self.data = self._encode()
        except (cantools.Error, struct.error, KeyError) as error:
            raise ConfigError(
                f"Message '{message.name}' of '{dbc.path}' cannot be made of {dict(values)}: {error}."
            ) from None

    def write(self, raw: float) -> None:
        """Write a raw value, limited to its bounds, into the varying signal."""
        low, high = self.bounds
        raw = min(max(raw, low), high)
        if self._is_whole:
            raw = round(raw)
        if self._packed is not None:
            layout, first_byte = self._packed
            layout.pack_into(self.data, first_byte, raw)
            return
        assert self._varying is not None
        self._raws[self._varying] = raw
        self.data[:] = self._encode()

    def _encode(self) -> bytearray:
        data = bytearray(size_of(self._message))
        if self._message.signals:
            encoded = self._message.encode(self._raws, scaling=False, strict=False)
            data[: len(encoded)] = encoded
        return data


def _layout(message: Message, signals: Sequence[Signal]) -> struct.Struct | None:
    """Return the layout of signals of a message, or None if `struct` cannot express it."""
    order = {_order(signal) for signal in signals if signal.length > 8} or {"<"}
    if len(order) > 1:
        return None
    layout, end = order.pop(), 0
    for signal in signals:
        code, start = _code(signal), _first_byte(signal)
        if code is None or start < end or signal.multiplexer_ids is not None:
            return None
        layout += f"{start - end}x{code}"
        end = start + signal.length // 8
    size = size_of(message)
    return struct.Struct(f"{layout}{size - end}x") if end <= size else None


def _shifts(message: Message, signals: Sequence[Signal]) -> Read | None:
    """Return a reader of whole numbers anywhere in a message; None if a signal is a float or multiplexed, or byte
    orders differ.
    """
    orders = {signal.byte_order for signal in signals}
    if len(orders) != 1 or any(signal.is_float or signal.multiplexer_ids is not None for signal in signals):
        return None
    is_little = orders == {"little_endian"}
    words, unpack = _words(size_of(message), "<" if is_little else ">", [_span(signal) for signal in signals])
    parts = []
    for signal in signals:
        first, end = _span(signal)
        number = next(n for n, (start, size) in enumerate(words) if 8 * start <= first and end <= 8 * (start + size))
        start, size = words[number]
        shift = first - 8 * start if is_little else 8 * (start + size) - end
        bits = f"words[{number}] >> {shift} & {(1 << signal.length) - 1}"
        sign = 1 << signal.length - 1
        parts.append(f"({bits} ^ {sign}) - {sign}" if signal.is_signed else bits)
    # One compiled expression takes half the time of a loop over the signals.
    parts[0] = parts[0].replace("words", "(words := unpack(data))", 1)
    read: Read = eval(f"lambda data: ({', '.join(parts)},)", {"unpack": unpack})
    return read


def _span(signal: Signal) -> tuple[int, int]:
    """Return first bit and end of a signal, counted in the order of its bits in the frame."""
    if signal.byte_order == "little_endian":
        return signal.start, signal.start + signal.length
    first = 8 * _first_byte(signal) + 7 - signal.start % 8  # the start bit is the highest of its byte order
    return first, first + signal.length


def _words(length: int, order: str, spans: Sequence[tuple[int, int]]) -> tuple[list[tuple[int, int]], Unpack]:
    """Return first byte and size of words that cut no span, and a function that unpacks a frame into them."""
    words, start = [], 0
    for size in (8, 4, 2, 1):
        while length - start >= size:
            words.append((start, size))
            start += size
    if all(any(8 * a <= first and end <= 8 * (a + size) for a, size in words) for first, end in spans):
        return words, struct.Struct(order + "".join(_INTEGERS[8 * size].upper() for _, size in words)).unpack
    byte_order: Literal["little", "big"] = "little" if order == "<" else "big"
    return [(0, length)], lambda data: (int.from_bytes(data, byte_order),)


def _code(signal: Signal) -> str | None:
    """Return the signal's format character of `struct`; None if it is not on whole bytes or has another length."""
    if signal.start % 8 != (0 if signal.byte_order == "little_endian" else 7):
        return None
    if signal.is_float:
        return _FLOATS.get(signal.length)
    code = _INTEGERS.get(signal.length)
    return code if code is None or signal.is_signed else code.upper()


def _order(signal: Signal) -> str:
    return "<" if signal.byte_order == "little_endian" else ">"


def _first_byte(signal: Signal) -> int:
    """Return the byte in which a signal begins: DBC counts start bits of both byte orders upwards from byte 0."""
    return signal.start // 8


def _suggest(name: str, known: Iterable[str]) -> str:
    names = sorted(known)
    matches = difflib.get_close_matches(name, names, 3)
    listed = ", ".join(names[:LISTED]) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")
    return (f"Did you mean {' or '.join(matches)}? " if matches else "") + f"It has: {listed or 'none'}."
