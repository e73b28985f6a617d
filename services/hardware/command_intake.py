"""Commands from zenoh to the robot: each is checked, and a bad one is counted and told, never followed.

So is one of anybody but who commands the robot; who streams commands while nobody does, does.
"""

import logging
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from hal.config import RobotConfig
from hal.errors import CommandRefused
from hal.robot import Robot
from services.errors import CommandHeld, LeaseLost
from services.hardware.lease import Lease
from services.wire import keys, messages
from services.wire.caller import LONGEST_NAME, Caller
from services.wire.messages import Command, MessageError
from services.wire.plain_text import plain, shown
from services.wire.streams import received_message

log = logging.getLogger(__name__)

DEPTH = 8
"""Commands kept between two cycles: a bad one must not push out the good one beside it, nor a flood fill the cycle."""
LOG_EVERY = 1.0
NEWS_FOR = 5.0
"""How long [s] a refused command is worth mentioning."""


class CommandIntake:
    """Takes the commands that came since the last cycle, in their order; the newest good one wins.

    Args:
        session: An open session.
        config: The robot file.
        robot: Whom to command.
        boot: This run of the HAL; a command that answers another run is refused.
        lease: Who commands.

    Attributes:
        sender: `boot` of whoever sent the last accepted command; 0 before the first.
    """

    def __init__(self, session: zenoh.Session, config: RobotConfig, robot: Robot, boot: int, lease: Lease) -> None:
        self.sender = 0
        self._lease = lease
        self._robot = robot
        self._signal = config.command.signal
        self._boot = boot
        self._counters = {"accepted": 0, "refused": 0, "malformed": 0}
        self._text = ""
        self._refused_at = self._logged_at = -math.inf
        self._subscriber = session.declare_subscriber(keys.command(config.robot), zenoh.handlers.RingChannel(DEPTH))

    def take(self) -> None:
        """Give the robot what came; never blocks, never raises because of a message."""
        for _ in range(DEPTH):
            sample = self._subscriber.try_recv()
            if sample is None:
                return
            self._offer(partial(received_message, sample, Command))

    def offer(self, data: bytes) -> None:
        """Give the robot one command as it was on the wire."""
        self._offer(lambda: messages.decode(data, Command))

    def _offer(self, read: Callable[[], Command]) -> None:
        try:
            command = read()
            caller = Caller(plain(command.name, LONGEST_NAME), command.boot)
            self._check(command)
            self._lease.check_stream(caller)
            self._robot.command(command.values, command.cycle)
        except (CommandRefused, CommandHeld, LeaseLost) as error:
            self._refuse("refused", str(error))
        except MessageError as error:
            self._refuse("malformed", str(error))
        except Exception as error:  # the cycle must turn, whatever came
            self._refuse("malformed", f"A command could not be read: {type(error).__name__}: {error}")
        else:
            self._lease.stream(caller)
            self._counters["accepted"] += 1
            self.sender = command.boot

    def facts(self) -> dict[str, Any]:
        """Counters, and why the last bad command was bad."""
        return {**self._counters, "text": self._text, "sender": self.sender}

    def news(self) -> str:
        """Why a command was not followed lately; empty when all were."""
        return self._text if time.monotonic() - self._refused_at < NEWS_FOR else ""

    def _check(self, command: Command) -> None:
        if command.signal != self._signal:
            raise CommandRefused(
                f"A command of {shown(command.signal)} was refused; this robot takes '{self._signal}'."
            )
        if command.hal_boot != self._boot:
            raise CommandRefused("A command was refused that answers a sample of another run of the HAL.")

    def _refuse(self, counter: str, text: str) -> None:
        self._counters[counter] += 1
        self._text = text = plain(text)
        self._refused_at = now = time.monotonic()
        if now - self._logged_at >= LOG_EVERY:
            self._logged_at = now
            log.warning("%s (%d refused, %d malformed so far)", text, self._counters["refused"],
                        self._counters["malformed"])  # fmt: skip
