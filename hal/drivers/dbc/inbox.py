"""What last came in the messages that a driver listens to, and questions about it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from cantools.database import Message
from cantools.database.can.signal import Signal

from hal.drivers.dbc.settings import ConditionConfig
from hal.protocols.dbc import Dbc, Reader, describe

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
