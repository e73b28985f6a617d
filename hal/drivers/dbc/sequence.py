"""Messages received, conditions on their signals, and steps that are sent one after the other without waiting."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import can
from cantools.database import Message
from cantools.database.can.signal import Signal

from hal.drivers.dbc.settings import ConditionConfig, FrameConfig, StepConfig
from hal.errors import ConfigError
from hal.protocols.dbc import Dbc, Reader, Writer, describe

TOLERANCE = 1e-6
"""Relative difference within which two numbers that are no whole ones count as equal."""

Raws = tuple[float, ...]


@dataclass(slots=True)
class Letter:
    """A message that is listened to.

    Attributes:
        message: The message.
        wanted: Its signals that somebody asks for.
        reader: Takes them out of a frame.
        raws: What came last, in the order of `reader.names`; empty before the first. Another tuple for each frame.
        received: When that was, monotonic [s].
        count: How many came since its pace was looked at.
    """

    message: Message
    wanted: set[str] = field(default_factory=set)
    reader: Reader | None = None
    raws: Raws = ()
    received: float = -math.inf
    count: int = 0


@dataclass(slots=True)
class Seen:
    """A signal that is listened to."""

    letter: Letter
    signal: Signal
    place: int = -1
    """In `letter.raws`."""

    @property
    def raw(self) -> float:
        """What it said last, as in the frame; NaN if nothing yet."""
        raws = self.letter.raws
        return raws[self.place] if raws else math.nan

    def words(self, is_bits: bool = False) -> str:
        """What it said last, in the DBC file's words."""
        return describe(self.signal, self.raw, is_bits)


@dataclass(slots=True)
class Condition:
    """What a signal is waited to say."""

    seen: Seen
    holds: Callable[[float], bool]
    text: str

    def newest(self) -> Raws:
        """What there is now, to tell later whether something newer has come."""
        return self.seen.letter.raws

    def is_met(self, since: Raws | None = None) -> bool:
        """Whether it says so, in a frame that came after `since` was taken."""
        raws = self.seen.letter.raws
        return bool(raws) and raws is not since and self.holds(raws[self.seen.place])


class Inbox:
    """All that is listened to; signals are asked for first, then `seal` makes the readers."""

    def __init__(self, dbc: Dbc) -> None:
        self.dbc = dbc
        self.letters: dict[str, Letter] = {}
        self._seen: list[Seen] = []

    def letter(self, message: str) -> Letter:
        """Listen to a message.

        Raises:
            ConfigError: There is no such message.
        """
        return self.letters.setdefault(message, Letter(self.dbc.message(message)))

    def signal(self, name: str) -> Seen:
        """Listen to `Message.Signal`.

        Raises:
            ConfigError: There is no such signal.
        """
        message, signal = self.dbc.signal(name)
        seen = Seen(self.letter(message.name), signal)
        seen.letter.wanted.add(signal.name)
        self._seen.append(seen)
        return seen

    def condition(self, config: ConditionConfig) -> Condition:
        """Listen to what a condition is about.

        Raises:
            ConfigError: There is no such signal or value.
        """
        seen = self.signal(config.signal)
        signal = seen.signal
        if config.below is not None:
            bound = config.below
            return Condition(
                seen, lambda raw: abs(raw * signal.scale + signal.offset) < bound, f"{config.signal} below {bound:g}"
            )
        values = config.one_of if config.equals is None else (config.equals,)
        raws = [self.dbc.raw(signal, value) for value in values]
        told = f"{config.signal} {' or '.join(f'{v:g}' if isinstance(v, float) else v for v in values)}"
        if signal.is_float:
            return Condition(seen, lambda raw: any(math.isclose(raw, one, rel_tol=TOLERANCE) for one in raws), told)
        return Condition(seen, frozenset(raws).__contains__, told)

    def seal(self) -> None:
        """Make the readers; nothing can be asked for after this."""
        for letter in self.letters.values():
            letter.reader = Reader(letter.message, letter.wanted)
        for seen in self._seen:
            assert seen.letter.reader is not None
            seen.place = seen.letter.reader.names.index(seen.signal.name)


RESEND = 0.2
"""A step that is not confirmed is sent again after so long [s]: the frame may be lost."""

STANDARD, EXTENDED = 0x7FF, 0x1FFFFFFF
"""Largest identifiers of 11 and of 29 bits."""

Send = Callable[[can.Message], bool]


@dataclass(frozen=True, slots=True)
class Address:
    """Which identifiers a node has.

    Attributes:
        node: Its node id.
        offset: What it adds to the identifiers of the DBC file per node id.
        extended: Whether identifiers have 29 bits; None: as the file says.
    """

    node: int
    offset: int
    extended: bool | None

    def identifier(self, base: int, extended: bool, what: str) -> tuple[int, bool]:
        """Identifier on the bus, and whether it has 29 bits.

        Raises:
            ConfigError: It has too many.
        """
        extended = extended if self.extended is None else self.extended
        identifier = base + self.node * self.offset
        largest = EXTENDED if extended else STANDARD
        if identifier > largest:
            raise ConfigError(
                f"node id {self.node} makes identifier {identifier:X}h of {what}, and the largest is {largest:X}h. "
                f"Node ids end at {max(largest - base, 0) // max(self.offset, 1)}."
            )
        return identifier, extended


@dataclass(frozen=True, slots=True)
class Step:
    """What a step of the robot file has become.

    Attributes:
        frame: What is sent; None if it only waits.
        until: What is waited for; None if nothing.
        unless: The step is left out if this is so already.
        cycles: How many cycles that may take.
        text: What is sent, for a person.
    """

    frame: can.Message | None
    until: Condition | None
    unless: Condition | None
    cycles: int
    text: str


def message_of(dbc: Dbc, address: Address, name: str, data: bytearray) -> can.Message:
    """The frame of a DBC message, to carry `data`.

    Raises:
        ConfigError: There is no such message, or its identifier does not fit.
    """
    message = dbc.message(name)
    identifier, extended = address.identifier(message.frame_id, message.is_extended_frame, f"message '{name}'")
    return can.Message(arbitration_id=identifier, is_extended_id=extended, data=data)


def compile_steps(steps: Sequence[StepConfig], inbox: Inbox, address: Address, rate: float) -> tuple[Step, ...]:
    """Steps of the robot file made ready to be sent at `rate` cycles per second.

    Raises:
        ConfigError: They name what the DBC file does not have.
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


def _raw(config: FrameConfig, address: Address) -> can.Message:
    identifier, extended = config.id, config.id > STANDARD
    if not config.broadcast:
        identifier, extended = address.identifier(config.id, extended, f"frame {config.id:X}h")
    return can.Message(
        arbitration_id=identifier, is_extended_id=extended, data=config.data or None, is_remote_frame=config.remote
    )


class Run:
    """One run of some steps; `advance` is called in every cycle until `is_over`."""

    def __init__(self, name: str, steps: Sequence[Step], rate: float, goes_on: bool = False) -> None:
        """Begin with the first step.

        Args:
            name: Of the sequence, for a person.
            steps: What is sent.
            rate: Cycles per second [Hz].
            goes_on: A step that is not confirmed in time does not end the run, as when stopping.
        """
        self.name = name
        self.failure = ""
        """Why it ended before its end; empty if it did not."""
        self._steps = tuple(steps)
        self._resend = max(1, round(RESEND * rate))
        self._goes_on = goes_on
        self._place = 0
        self._waited = -1
        self._since: Raws = ()

    @property
    def is_over(self) -> bool:
        """Whether nothing is left to do."""
        return self._place >= len(self._steps) or bool(self.failure)

    @property
    def has_sent_last(self) -> bool:
        """Whether the last step has been sent."""
        return self._place >= len(self._steps) or (self._place == len(self._steps) - 1 and self._waited >= 0)

    def advance(self, send: Send) -> None:
        """One cycle: send the next step, or see whether the one that was sent is confirmed."""
        if self.is_over:
            return
        step = self._steps[self._place]
        self._waited += 1
        if self._waited == 0:
            if step.unless is not None and step.unless.is_met():
                self._next()
                return
            self._since = step.until.newest() if step.until else ()
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
                said = step.until.seen.words() if step.until.newest() else "nothing"
                self.failure = f"after {step.text} it does not say {step.until.text}, but {said}"
        elif step.frame is not None and self._waited % self._resend == 0:
            send(step.frame)

    def _next(self) -> None:
        self._place += 1
        self._waited = -1
