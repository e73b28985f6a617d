"""Intake of commands and targets from the network: a bad message is counted and reported, not followed."""

import logging
import math
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import zenoh

from hal.errors import CommandRefused
from hal.robot import Robot
from services.command.lease import Lease
from services.errors import CommandHeld, LeaseLost, TargetRefused
from services.wire.caller import LONGEST_NAME, Caller
from services.wire.messages import Command, Message, MessageError
from services.wire.plain_text import plain, shown
from services.wire.streams import received_message

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)

DEPTH = 8
"""At most this many messages wait for a tick: a bad one must not displace a good one, and a flood must stay short."""
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
        counters: Numbers of messages that were `accepted`, `refused` and `malformed`.
    """

    def __init__(self, session: zenoh.Session, key: str, record: type[M], use: Callable[[M], None]) -> None:
        self.counters = {"accepted": 0, "refused": 0, "malformed": 0}
        self._record, self._use = record, use
        self._text = ""
        self._refused_at = self._logged_at = -math.inf
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(DEPTH))

    def take(self) -> None:
        """Follow the waiting messages; never wait, and never raise because of a message."""
        for _ in range(DEPTH):
            sample = self._subscriber.try_recv()
            if sample is None:
                return
            self._follow(sample)

    def _follow(self, sample: zenoh.Sample) -> None:
        try:
            self._use(received_message(sample, self._record))
        except (CommandRefused, CommandHeld, LeaseLost, TargetRefused) as error:
            self._refuse("refused", str(error))
        except MessageError as error:
            self._refuse("malformed", str(error))
        except Exception as error:  # no message may end the tick
            self._refuse("malformed", f"A {self._record.TYPE} could not be read: {type(error).__name__}: {error}")
        else:
            self.counters["accepted"] += 1

    def facts(self) -> dict[str, Any]:
        """Return the counters, and the fault of the last bad message as `text`."""
        return {**self.counters, "text": self._text}

    def news(self) -> str:
        """Return the fault of the last bad message for `NEWS_FOR` seconds; empty otherwise."""
        return self._text if time.monotonic() - self._refused_at < NEWS_FOR else ""

    def _refuse(self, counter: str, text: str) -> None:
        self.counters[counter] += 1
        self._text = text = plain(text)
        self._refused_at = now = time.monotonic()
        if now - self._logged_at >= LOG_EVERY:
            self._logged_at = now
            log.warning("%s (%d refused, %d malformed so far)", text, self.counters["refused"],
                        self.counters["malformed"])  # fmt: skip


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
