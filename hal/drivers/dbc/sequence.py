"""Received messages, conditions on their signals, and steps that are sent cycle by cycle without blocking."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import can
from cantools.database import Message
from cantools.database.can.signal import Signal

from hal.drivers.dbc.settings import ConditionConfig, FrameConfig, StepConfig
from hal.errors import ConfigError
from hal.protocols.dbc import Dbc, SignalReader, Writer, describe, is_fd

TOLERANCE = 1e-6
"""Two values that are not whole numbers are equal within this relative difference."""

Raws = tuple[float, ...]


@dataclass(slots=True)
class InputMessage:
    """A message that the driver receives.

    Attributes:
        definition: The message in the DBC file.
        names: Names of the signals in use.
        reader: Reads these signals from a frame.
        raws: Newest raw values in the order of `reader.names`; empty before the first frame. Each frame makes a new
            tuple.
        received: Monotonic time of the newest frame [s].
        count: Frames since the last check of the sending rate.
    """

    definition: Message
    names: set[str] = field(default_factory=set)
    reader: SignalReader | None = None
    raws: Raws = ()
    received: float = -math.inf
    count: int = 0


@dataclass(slots=True)
class InputSignal:
    """A signal that the driver receives."""

    message: InputMessage
    definition: Signal
    index: int = -1
    """Index in `message.raws`."""

    @property
    def raw(self) -> float:
        """Newest raw value; NaN before the first frame."""
        raws = self.message.raws
        return raws[self.index] if raws else math.nan

    def describe(self, is_bits: bool = False) -> str:
        """Return the newest value as the DBC file names it."""
        return describe(self.definition, self.raw, is_bits)


@dataclass(slots=True)
class Condition:
    """A condition on the value of a signal."""

    signal: InputSignal
    holds: Callable[[float], bool]
    text: str

    @property
    def newest(self) -> Raws:
        """Newest raw values of the message, by which `is_met` recognises a later frame."""
        return self.signal.message.raws

    def is_met(self, since: Raws | None = None) -> bool:
        """Return whether the condition holds, in a frame later than the one of `since`."""
        raws = self.newest
        return bool(raws) and raws is not since and self.holds(raws[self.signal.index])


class Inbox:
    """All messages that the driver receives. Request the signals first; then `seal` makes the readers."""

    def __init__(self, dbc: Dbc) -> None:
        self.dbc = dbc
        self.messages: dict[str, InputMessage] = {}
        self._signals: list[InputSignal] = []

    def message(self, name: str) -> InputMessage:
        """Receive a message.

        Raises:
            ConfigError: There is no such message.
        """
        return self.messages.setdefault(name, InputMessage(self.dbc.message(name)))

    def signal(self, name: str) -> InputSignal:
        """Receive `Message.Signal`.

        Raises:
            ConfigError: There is no such signal.
        """
        message, definition = self.dbc.signal(name)
        signal = InputSignal(self.message(message.name), definition)
        signal.message.names.add(definition.name)
        self._signals.append(signal)
        return signal

    def condition(self, config: ConditionConfig) -> Condition:
        """Receive the signal of a condition.

        Raises:
            ConfigError: There is no such signal or value.
        """
        signal = self.signal(config.signal)
        definition = signal.definition
        if config.below is not None:
            bound = config.below
            return Condition(
                signal,
                lambda raw: abs(raw * definition.scale + definition.offset) < bound,
                f"{config.signal} below {bound:g}",
            )
        values = config.one_of if config.equals is None else (config.equals,)
        raws = [self.dbc.raw(definition, value) for value in values]
        text = f"{config.signal} {' or '.join(f'{v:g}' if isinstance(v, float) else v for v in values)}"
        if definition.is_float:
            return Condition(signal, lambda raw: any(math.isclose(raw, one, rel_tol=TOLERANCE) for one in raws), text)
        return Condition(signal, frozenset(raws).__contains__, text)

    def seal(self) -> None:
        """Make the readers; no further signals can be requested."""
        for message in self.messages.values():
            message.reader = SignalReader(message.definition, message.names)
        for signal in self._signals:
            assert signal.message.reader is not None
            signal.index = signal.message.reader.names.index(signal.definition.name)


RESEND = 0.2
"""An unconfirmed step is sent again after this time [s], because the frame may be lost."""

STANDARD, EXTENDED = 0x7FF, 0x1FFFFFFF
"""Largest identifiers of 11 and of 29 bits."""

Send = Callable[[can.Message], bool]


@dataclass(frozen=True, slots=True)
class Address:
    """The identifiers of a node.

    Attributes:
        node: Its node id.
        offset: Added to the identifiers of the DBC file per node id.
        extended: Whether identifiers have 29 bits; None: as in the DBC file.
    """

    node: int
    offset: int
    extended: bool | None

    def identifier(self, base: int, extended: bool, what: str) -> tuple[int, bool]:
        """Return the identifier on the bus, and whether it has 29 bits.

        Raises:
            ConfigError: The identifier is too large.
        """
        extended = extended if self.extended is None else self.extended
        identifier = base + self.node * self.offset
        largest = EXTENDED if extended else STANDARD
        if identifier > largest:
            raise ConfigError(
                f"node id {self.node} gives {what} the identifier {identifier:X}h, above the largest, {largest:X}h. "
                f"The largest node id is {max(largest - base, 0) // max(self.offset, 1)}."
            )
        return identifier, extended


@dataclass(frozen=True, slots=True)
class Step:
    """A compiled step of the robot file.

    Attributes:
        frame: Frame to send; None if the step only waits.
        until: Condition that ends the step; None if it ends at once.
        unless: The step is skipped if this condition holds.
        cycles: Most cycles until the condition must hold.
        text: Description of the frame for messages.
    """

    frame: can.Message | None
    until: Condition | None
    unless: Condition | None
    cycles: int
    text: str


def message_of(dbc: Dbc, address: Address, name: str, data: bytearray) -> can.Message:
    """Return the frame of a DBC message with `data`.

    Raises:
        ConfigError: There is no such message, or its identifier does not fit.
    """
    message = dbc.message(name)
    identifier, extended = address.identifier(message.frame_id, message.is_extended_frame, f"message '{name}'")
    fd = is_fd(message)
    return can.Message(arbitration_id=identifier, is_extended_id=extended, is_fd=fd, bitrate_switch=fd, data=data)


def compile_steps(steps: Sequence[StepConfig], inbox: Inbox, address: Address, rate: float) -> tuple[Step, ...]:
    """Compile steps of the robot file for `rate` cycles per second.

    Raises:
        ConfigError: A name in them is not in the DBC file.
    """
    compiled = []
    for step in steps:
        frame, text = None, "waiting"
        if step.send is not None:
            writer = Writer(inbox.dbc, inbox.dbc.message(step.send), step.values)
            frame = message_of(inbox.dbc, address, step.send, writer.data)
            text = " ".join(
                [step.send, *(f"{value:g}" if isinstance(value, float) else value for value in step.values.values())]
            )
        elif step.frame is not None:
            frame = _raw(step.frame, address)
            text = f"frame {frame.arbitration_id:03X}h"
        cycles = 0 if step.until is None else max(1, round(step.until.within * rate))
        until = inbox.condition(step.until) if step.until else None
        unless = inbox.condition(step.unless) if step.unless else None
        compiled.append(Step(frame, until, unless, cycles, text))
    return tuple(compiled)


def is_extended(config: FrameConfig, extended: bool | None) -> bool:
    """Whether a frame of the robot file has an identifier of 29 bits; `extended` as in `Address`."""
    return config.id > STANDARD if config.broadcast or extended is None else extended


def _raw(config: FrameConfig, address: Address) -> can.Message:
    identifier, extended = config.id, config.id > STANDARD
    if not config.broadcast:
        identifier, extended = address.identifier(config.id, extended, f"frame {config.id:X}h")
    return can.Message(
        arbitration_id=identifier, is_extended_id=extended, data=config.data or None, is_remote_frame=config.remote
    )


class SequenceRun:
    """One run of a sequence of steps. Call `advance` in every cycle until `is_over`."""

    def __init__(self, name: str, steps: Sequence[Step], rate: float, goes_on: bool = False) -> None:
        """Begin with the first step.

        Args:
            name: Name of the sequence in messages.
            steps: The steps.
            rate: Cycles per second [Hz].
            goes_on: Whether the run continues after a step that is not confirmed in time, as in a stop.
        """
        self.name = name
        self.failure = ""
        """Reason why the run failed; empty if it did not."""
        self._steps = tuple(steps)
        self._resend = max(1, round(RESEND * rate))
        self._goes_on = goes_on
        self._index = 0
        self._waited = -1
        self._since: Raws = ()

    @property
    def is_over(self) -> bool:
        """Whether the run has ended."""
        return self._index >= len(self._steps) or bool(self.failure)

    @property
    def has_sent_last(self) -> bool:
        """Whether the last step has been sent."""
        return self._index >= len(self._steps) or (self._index == len(self._steps) - 1 and self._waited >= 0)

    def advance(self, send: Send) -> None:
        """Send the next step, or check whether the sent one is confirmed; once per cycle."""
        if self.is_over:
            return
        step = self._steps[self._index]
        self._waited += 1
        if self._waited == 0:
            if step.unless is not None and step.unless.is_met():
                self._next()
                return
            self._since = step.until.newest if step.until else ()
            if step.frame is not None:
                send(step.frame)
            if step.until is None:
                self._next()
            return
        assert step.until is not None
        if step.until.is_met(self._since):
            self._next()
        elif self._waited >= step.cycles:
            if self._goes_on:
                self._next()
            else:
                value = step.until.signal.describe() if step.until.newest else "nothing"
                self.failure = f"after {step.text} it does not report {step.until.text}, but {value}"
        elif step.frame is not None and self._waited % self._resend == 0:
            send(step.frame)

    def _next(self) -> None:
        self._index += 1
        self._waited = -1
