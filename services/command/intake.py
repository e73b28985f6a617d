"""Commands and targets from the network: each is read and checked; a bad one is counted and reported, not followed."""

import logging
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Generic, TypeVar

import zenoh

from hal.errors import CommandRefused
from hal.robot import Robot
from services.command.lease import Lease
from services.errors import CommandHeld, LeaseLost, TargetRefused
from services.wire import messages
from services.wire.caller import LONGEST_NAME, Caller
from services.wire.messages import Command, Message, MessageError
from services.wire.plain_text import plain, shown
from services.wire.streams import received_message

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)

DEPTH = 8
"""Messages kept between two turns: a bad one must not push out a good one, nor a flood fill the turn."""
LOG_EVERY = 1.0
"""Shortest time [s] between two log lines about bad messages."""
NEWS_FOR = 5.0
"""A bad message is mentioned in the status for this long [s]."""


class Intake(Generic[M]):
    """Hands on the messages of a key that came since the last turn, in their order.

    Args:
        session: An open session.
        key: Key to subscribe to.
        record: Type of its messages.
        use: Follows a message; raises `CommandRefused`, `CommandHeld`, `LeaseLost`, `TooLate` or `TargetRefused` if it
            must not.

    Attributes:
        counters: How many messages were `accepted`, `refused` and `malformed`.
    """

    def __init__(self, session: zenoh.Session, key: str, record: type[M], use: Callable[[M], None]) -> None:
        self.counters = {"accepted": 0, "refused": 0, "malformed": 0}
        self._record, self._use = record, use
        self._text = ""
        self._refused_at = self._logged_at = -math.inf
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(DEPTH))

    def take(self) -> None:
        """Follow the messages that came; never blocks, and never raises because of a message."""
        for _ in range(DEPTH):
            sample = self._subscriber.try_recv()
            if sample is None:
                return
            self._offer(partial(received_message, sample, self._record))

    def offer(self, data: bytes) -> None:
        """Follow one message in its wire form."""
        self._offer(lambda: messages.decode(data, self._record))

    def _offer(self, read: Callable[[], M]) -> None:
        try:
            self._use(read())
        except (CommandRefused, CommandHeld, LeaseLost, TargetRefused) as error:
            self._refuse("refused", str(error))
        except MessageError as error:
            self._refuse("malformed", str(error))
        except Exception as error:  # the turn must go on, whatever came
            self._refuse("malformed", f"A {self._record.TYPE} could not be read: {type(error).__name__}: {error}")
        else:
            self.counters["accepted"] += 1

    def facts(self) -> dict[str, Any]:
        """Return the counters, and in `text` the fault of the last bad message."""
        return {**self.counters, "text": self._text}

    def news(self) -> str:
        """Return the fault of a bad message of the last `NEWS_FOR` seconds; empty if there was none."""
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
    """The rules by which the HAL follows a command: right signal, this run of the HAL, and the sender may command.

    Args:
        robot: The robot that is commanded.
        signal: Its commanded signal.
        boot: This run of the HAL.
        lease: The robot's lease; a client that streams commands takes it if it is free.

    Attributes:
        sender: `boot` of the sender of the last accepted command; 0 before the first.
    """

    def __init__(self, robot: Robot, signal: str, boot: int, lease: Lease) -> None:
        self.sender = 0
        self._robot, self._signal, self._boot, self._lease = robot, signal, boot, lease

    def follow(self, command: Command) -> None:
        """Give the robot a command.

        Raises:
            CommandRefused: It is for another signal or run of the HAL, or the robot refuses it.
            CommandHeld, LeaseLost: The sender may not command; see `Lease.check_stream`.
        """
        caller = Caller(plain(command.name, LONGEST_NAME), command.boot)
        if command.signal != self._signal:
            raise CommandRefused(
                f"A command of {shown(command.signal)} was refused. This robot takes '{self._signal}'."
            )
        if command.hal_boot != self._boot:
            raise CommandRefused("A command was refused that answers a sample of another run of the HAL.")
        self._lease.check_stream(caller)
        self._robot.command(command.values, command.cycle)
        self._lease.stream(caller)
        self.sender = command.boot
