"""Commands from zenoh to the robot: each is checked, and a bad one is counted and told, never followed."""

import logging
import math
import time
from typing import Any

import zenoh

from hal.config import RobotConfig
from hal.errors import CommandRefused
from hal.robot import Robot
from services import keys, messages
from services.messages import Command, MessageError

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

    Attributes:
        sender: `boot` of whoever sent the last accepted command; 0 before the first.
    """

    def __init__(self, session: zenoh.Session, config: RobotConfig, robot: Robot, boot: int) -> None:
        self.sender = 0
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
            self.offer(sample.payload.to_bytes())

    def offer(self, data: bytes) -> None:
        """Give the robot one command as it was on the wire."""
        try:
            command = messages.decode(data, Command)
            self._check(command)
            self._robot.command(command.values, command.cycle)
        except MessageError as error:
            self._refuse("malformed", str(error))
        except CommandRefused as error:
            self._refuse("refused", str(error))
        else:
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
            raise CommandRefused(f"A command of '{command.signal}' was refused; this robot takes '{self._signal}'.")
        if command.hal_boot != self._boot:
            raise CommandRefused("A command was refused that answers a sample of another run of the HAL.")

    def _refuse(self, counter: str, text: str) -> None:
        self._counters[counter] += 1
        self._text = text
        self._refused_at = now = time.monotonic()
        if now - self._logged_at >= LOG_EVERY:
            self._logged_at = now
            log.warning("%s (%d refused, %d malformed so far)", text, self._counters["refused"],
                        self._counters["malformed"])  # fmt: skip
