"""Frames of a simulated node with a DBC file: values into messages that it sends, and frames that it recognises."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cantools
from cantools.database import Message
from cantools.database.can.signal import Signal

from hal.drivers.dbc.settings import ConditionConfig, StepConfig, Value
from hal.errors import ConfigError
from hal.protocols.dbc import Dbc, size_of
from simulators.nodes.node import EXTENDED, REMOTE

LARGEST_STANDARD = 0x7FF
LARGEST_FLOAT = 3.4e38


def raw_of(signal: Signal, value: Value) -> float:
    """Return the raw value of a number in the unit of the DBC file, or of a name; as far as it fits.

    Raises:
        ConfigError: The signal has no value of that name.
    """
    if isinstance(value, str):
        names = {str(choice): float(raw) for raw, choice in (signal.choices or {}).items()}
        if value not in names:
            raise ConfigError(f"Signal '{signal.name}' has no value '{value}'. It has: {', '.join(names) or 'none'}.")
        return names[value]
    raw = (value - signal.offset) / signal.scale
    if signal.is_float:
        return min(max(raw, -LARGEST_FLOAT), LARGEST_FLOAT)
    if math.isnan(raw):
        return 0.0
    low = -(1 << signal.length - 1) if signal.is_signed else 0
    high = (1 << signal.length - signal.is_signed) - 1
    return float(min(max(round(min(max(raw, low), high)), low), high))


@dataclass(slots=True)
class Output:
    """A message that the node sends.

    Attributes:
        definition: The message in the DBC file.
        identifier: Identifier on the bus, with its flag for 29 bits.
        raws: Signal -> newest raw value.
        pages: Values of the multiplexer whose pages are sent in turn; empty if the message is not multiplexed.
    """

    definition: Message
    identifier: int
    raws: dict[str, float] = field(default_factory=dict)
    pages: list[int] = field(default_factory=list)
    turn: int = 0

    def __post_init__(self) -> None:
        """Begin with the start values of the DBC file, or else 0."""
        for signal in self.definition.signals:
            start = signal.raw_initial
            self.raws[signal.name] = float(start) if isinstance(start, int | float) else raw_of(signal, 0.0)

    def signal(self, name: str) -> Signal:
        """Return a signal of the message."""
        return self.definition.get_signal_by_name(name)

    def use(self, name: str) -> None:
        """Send the page of a signal too, if the message is multiplexed."""
        for page in self.signal(name).multiplexer_ids or ():
            if page not in self.pages:
                self.pages.append(page)

    def put(self, name: str, value: Value) -> None:
        """Set a signal [unit of the DBC file]."""
        self.raws[name] = raw_of(self.signal(name), value)

    def _known_pages(self) -> list[int]:
        return sorted({page for signal in self.definition.signals for page in signal.multiplexer_ids or ()})[:1] or [0]

    def check(self) -> None:
        """Refuse a message that cannot be sent.

        Raises:
            ConfigError: cantools cannot encode it, as some with pages within pages.
        """
        try:
            self.encode()
        except (cantools.Error, KeyError) as error:
            raise ConfigError(f"Message '{self.definition.name}' cannot be simulated: {error}.") from None

    def encode(self) -> bytes:
        """Return the data of the next frame; a multiplexed message sends its pages in turn."""
        values = dict(self.raws)
        if self.definition.is_multiplexed():
            for signal in self.definition.signals:
                if signal.is_multiplexer and signal.multiplexer_ids is None:
                    pages = self.pages or self._known_pages()
                    values[signal.name] = pages[self.turn % len(pages)]
            self.turn += 1
        whole = {
            signal.name: values[signal.name] if signal.is_float else int(values[signal.name])
            for signal in self.definition.signals
        }
        data = b"" if not whole else bytes(self.definition.encode(whole, scaling=False, strict=False))
        return data.ljust(size_of(self.definition), b"\0")


class Numbering:
    """Identifiers of one node: those of the DBC file, moved by its node id."""

    def __init__(self, node: int, offset: int, is_extended: bool | None) -> None:
        self._shift = node * offset
        self._is_extended = is_extended

    def of(self, message: Message) -> int:
        """Return the identifier of a message on the bus, with its flag for 29 bits."""
        return self._flagged(message.frame_id + self._shift, message.is_extended_frame)

    def of_step(self, dbc: Dbc, step: StepConfig) -> int:
        """Return the identifier of the frame of a step, with its flags."""
        if step.send is not None:
            return self.of(dbc.message(step.send))
        assert step.frame is not None
        plain, is_extended = step.frame.id, step.frame.id > LARGEST_STANDARD
        if step.frame.broadcast:
            identifier = plain | (EXTENDED if is_extended else 0)
        else:
            identifier = self._flagged(plain + self._shift, is_extended)
        return identifier | (REMOTE if step.frame.remote else 0)

    def _flagged(self, identifier: int, is_extended: bool) -> int:
        is_extended = is_extended if self._is_extended is None else self._is_extended
        return identifier | (EXTENDED if is_extended else 0)


class Request:
    """A frame of a step: recognised by its identifier, and by the values that the step states."""

    def __init__(self, dbc: Dbc, step: StepConfig, numbering: Numbering) -> None:
        self.identifier = numbering.of_step(dbc, step)
        self.name = step.send
        self.until: ConditionConfig | None = step.until
        self._message = None if step.send is None else dbc.message(step.send)
        self._data = bytes(step.frame.data) if step.frame is not None else b""
        values = step.values.items() if self._message is not None else ()
        self._raws = {name: raw_of(dbc.signal_of(dbc.message(str(step.send)), name), value) for name, value in values}

    def is_in(self, data: bytes) -> bool:
        """Whether a frame with the right identifier is this request."""
        if self._message is None:
            return data[: len(self._data)] == self._data
        raws = decoded(self._message, data)
        return raws is not None and all(_is_same(raws.get(name), raw) for name, raw in self._raws.items())


def _is_same(one: float | None, other: float) -> bool:
    return one is not None and math.isclose(one, other, rel_tol=1e-6)


def decoded(message: Message, data: bytes) -> Mapping[str, float] | None:
    """Return signal -> raw value of a frame; None if the message cannot be such a frame."""
    if len(data) < message.length:
        return None
    if not message.signals:
        return {}
    try:
        values: Any = message.decode(data, decode_choices=False, scaling=False)
    except cantools.Error:
        return None  # such as a page of a multiplexed message that the file does not have
    return {name: float(value) for name, value in values.items()}
