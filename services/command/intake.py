"""Intake of commands and targets from the network: a bad message is counted and reported, not followed."""

import logging
import math
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import msgspec
import zenoh

from hal.errors import CommandRefused
from hal.robot import Robot
from services.command.lease import Lease
from services.errors import CommandHeld, LeaseLost, TargetRefused
from services.wire.caller import LONGEST_NAME, Caller
from services.wire.messages import UNREADABLE, Command, Message, MessageError
from services.wire.order import Order
from services.wire.plain_text import plain, shown
from services.wire.streams import received_message

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)

DEPTH = 8
"""At most this many messages of a sender wait for a tick: a bad one must not displace a good one."""
SENDERS = 64
"""At most this many senders have a ring of their own; the one that was silent longest loses it to a new one."""
NEW_SENDERS = 64
"""At most this many senders get a ring in a tick; messages of more are only counted."""
PER_TICK = 16
"""At most this many messages are followed in a tick, of all senders in turn, so that a flood stays short."""
WAITING = 2048
"""At most this many messages of a key wait for a tick, in a ring that the session fills without running Python."""
LARGE = 1 << 14
"""Messages of more bytes than this share the ring of messages without a sender."""
LOG_EVERY = 1.0
"""Two log lines about bad messages are at least this long [s] apart."""
NEWS_FOR = 5.0
"""The status reports a bad message for this long [s]."""


class Intake(Generic[M]):
    """Subscription of a tick: the messages of a key since the last tick, followed in their order.

    Args:
        session: An open session.
        key: Key to subscribe to.
        record: Type of its messages.
        use: Function that follows a message; raises `CommandRefused`, `CommandHeld`, `LeaseLost`, `TooLate` or
            `TargetRefused` if the message is refused.

    Attributes:
        counters: Numbers of messages that were `accepted`, `refused`, `malformed`, or dropped because their sender
            sends too many (`flooded`; without those that more than `WAITING` in a tick have displaced).
    """

    def __init__(self, session: zenoh.Session, key: str, record: type[M], use: Callable[[M], None]) -> None:
        self.counters = {"accepted": 0, "refused": 0, "malformed": 0, "flooded": 0}
        self._record, self._use = record, use
        self._text = ""
        self._refused_at = self._logged_at = -math.inf
        self._order = Order()
        self._rings = Rings()
        # a callback would run for each message of a flood, and keep the interpreter from the cycle
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(WAITING))

    def take(self) -> None:
        """Follow the waiting messages; never wait, and never raise because of a message."""
        self._collect()
        flooded = self._rings.dropped
        if flooded != self.counters["flooded"]:
            self.counters["flooded"] = flooded
            self._tell(
                f"More than {DEPTH} {self._record.TYPE} messages of a sender came in a tick; the oldest are dropped."
            )
        for sample in self._rings.take(PER_TICK):
            self._follow(sample)

    def _collect(self) -> None:
        handler = self._subscriber.handler
        for _ in range(WAITING):
            if (sample := handler.try_recv()) is None:
                return
            self._rings.put(sample)

    def _follow(self, sample: zenoh.Sample) -> None:
        try:
            message = received_message(sample, self._record)
            if not self._order.problem(message):
                self._use(message)
                self._rings.kept = message.boot
                self.counters["accepted"] += 1
                return
            self._tell(self._order.text)
        except (CommandRefused, CommandHeld, LeaseLost, TargetRefused) as error:
            self._refuse("refused", str(error))
        except MessageError as error:
            self._refuse("malformed", str(error))
        except Exception as error:  # no message may end the tick
            self._refuse("malformed", f"A {self._record.TYPE} could not be read: {type(error).__name__}: {error}")

    def facts(self) -> dict[str, Any]:
        """Return the counters, and the fault of the last bad message as `text`."""
        return {**self.counters, **self._order.counters, "text": self._text}

    def news(self) -> str:
        """Return the fault of the last bad message for `NEWS_FOR` seconds; empty otherwise."""
        return self._text if time.monotonic() - self._refused_at < NEWS_FOR else ""

    def _refuse(self, counter: str, text: str) -> None:
        self.counters[counter] += 1
        self._tell(text)

    def _tell(self, text: str) -> None:
        self._text = text = plain(text)
        self._refused_at = now = time.monotonic()
        if now - self._logged_at >= LOG_EVERY:
            self._logged_at = now
            log.warning("%s (%d refused, %d malformed so far)", text, self.counters["refused"],
                        self.counters["malformed"])  # fmt: skip


class _Header(msgspec.Struct):
    """The sender of a message."""

    boot: int = 0


_sender_of = msgspec.msgpack.Decoder(_Header).decode


class Rings:
    """A ring of waiting messages per sender, so that one sender's flood does not displace the messages of another.

    Attributes:
        dropped: Number of messages that newer ones of the same sender, or other senders, have displaced.
        kept: Sender who keeps its ring and comes first, because its last message was accepted; None before the first.
    """

    def __init__(self) -> None:
        self.dropped = self._new = 0
        self.kept: int | None = None
        self._rings: OrderedDict[int, deque[zenoh.Sample]] = OrderedDict()

    def put(self, sample: zenoh.Sample) -> None:
        """Add a message."""
        sender = 0
        if len(sample.payload) <= LARGE:
            try:
                sender = _sender_of(sample.payload.to_bytes()).boot
            except UNREADABLE:  # the tick will count it
                sender = 0
        ring = self._rings.get(sender)
        if ring is None:
            self._new += 1
            if self._new > NEW_SENDERS:
                self.dropped += 1
                return
            if len(self._rings) >= SENDERS:
                oldest = next(known for known in self._rings if known != self.kept)
                self.dropped += len(self._rings.pop(oldest))
            ring = self._rings[sender] = deque(maxlen=DEPTH)
        self._rings.move_to_end(sender)
        self.dropped += len(ring) == DEPTH
        ring.append(sample)

    def take(self, most: int) -> list[zenoh.Sample]:
        """Remove and return at most this number of messages, the oldest of each sender first."""
        self._new = 0
        taken: list[zenoh.Sample] = []
        rings = self._rings
        first = [rings[self.kept]] if self.kept is not None and self.kept in rings else []
        waiting = [ring for ring in first + [rings[one] for one in rings if one != self.kept] if ring]
        while waiting and len(taken) < most:
            taken.extend(ring.popleft() for ring in waiting[: most - len(taken)])
            waiting = [ring for ring in waiting if ring]
        return taken


class Commands:
    """Check of each command in the HAL: its signal, its run of the HAL, and the permission of its sender.

    Args:
        robot: The robot that is commanded.
        signal: The robot's commanded signal.
        boot: Number of this run of the HAL.
        lease: The robot's lease; a client that streams commands takes a free lease.

    Attributes:
        sender: `boot` of the sender of the last accepted command; 0 before the first.
    """

    def __init__(self, robot: Robot, signal: str, boot: int, lease: Lease) -> None:
        self.sender = 0
        self._robot, self._signal, self._boot, self._lease = robot, signal, boot, lease

    def follow(self, command: Command) -> None:
        """Give the robot a command.

        Raises:
            CommandRefused: The command is for another signal or run of the HAL, or the robot refuses the command.
            CommandHeld, LeaseLost: The sender may not command; see `Lease.check_stream`.
        """
        caller = Caller(plain(command.name, LONGEST_NAME), command.boot)
        if command.signal != self._signal:
            raise CommandRefused(
                f"A command of {shown(command.signal)} was refused. This robot takes '{self._signal}'."
            )
        if command.hal_boot != self._boot:
            raise CommandRefused("A command was refused because it answers a sample of another run of the HAL.")
        self._lease.check_stream(caller)
        self._robot.command(command.values, command.cycle)
        self._lease.stream(caller)
        self.sender = command.boot
