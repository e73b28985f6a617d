"""A robot that can be moved and looked at: without a bus as fast as it computes, or a running one in its own time."""

import time
from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np

from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.robot import Robot
from services.client import Client
from services.errors import ServiceError
from services.model.estimation import Freshness
from services.wire import keys
from services.wire.messages import Sample

ENABLE_WITHIN = 5.0
"""Time [s] within which the drives must be enabled."""

Values = Mapping[str, np.ndarray]


class CollectionStopped(ServiceError):
    """The robot stopped before enough was recorded; the text says why."""


class Playground(Protocol):
    """A robot that can be moved and looked at."""

    start: np.ndarray
    """Where the robot was when it was enabled [unit of the commanded signal], shape (k,)."""

    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        """Hold a command [unit of the commanded signal], shape (k,), for so long [s]; yield what is to be recorded."""
        ...

    def elapsed(self) -> float:
        """The robot's own time [s]."""
        ...


class DirectPlayground:
    """A simulated robot without a bus; its time is the simulation's."""

    def __init__(self, robot: Robot, rate: float) -> None:
        """Enable the robot; `rate` [Hz] is how often a sample is recorded.

        Raises:
            CollectionStopped: The drives do not come.
        """
        self._robot = robot
        self._every = max(1, round(1.0 / (rate * robot.period)))
        self._next = robot.clock.monotonic()
        self._began = self._next
        self._cycle = 0
        self.start = self._turn()[robot.config.command.signal].copy()
        robot.enable()
        for _ in range(round(ENABLE_WITHIN / robot.period)):
            self._turn()
            if robot.mode in ("hold", "follow"):
                return
        raise CollectionStopped(f"The drives did not become enabled within {ENABLE_WITHIN:g} s: mode '{robot.mode}'.")

    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        """See `Playground.play`."""
        robot = self._robot
        for _ in range(max(1, round(duration / robot.period))):
            robot.command(command, self._cycle)
            sample = self._turn()
            if robot.mode == "fault":
                raise CollectionStopped(f"The robot stopped: {robot.fault_text}")
            if self._cycle % self._every == 0:
                yield sample

    def elapsed(self) -> float:
        """See `Playground.elapsed`."""
        return self._robot.clock.monotonic() - self._began

    def _turn(self) -> Values:
        sample, _ = self._robot.cycle()
        self._cycle = sample.cycle
        self._next += self._robot.period
        self._robot.clock.sleep_until(self._next)
        return sample.values


class BusPlayground:
    """A running robot, and its camera if it has one; its time is the wall's."""

    def __init__(self, robot: RobotConfig, client: Client, rate: float) -> None:
        """Enable the robot; `rate` [Hz] is how often a sample is recorded.

        Raises:
            ServiceUnavailable: No HAL answers.
            CommandRefused: It does not enable.
            CollectionStopped: The drives do not come.
        """
        self._robot, self._client = robot, client
        self._interval = 1.0 / rate
        self._samples = client.reader(keys.sample(robot.robot), Sample)
        seen = client.reader(keys.vision(robot.robot), Sample)
        self._freshness = Freshness(robot, self._samples.last, SystemClock(), seen.last if robot.seen else None)
        self._began = self._recorded = time.monotonic()
        deadline = time.monotonic() + ENABLE_WITHIN
        client.enable()
        while self._mode() not in ("hold", "follow"):
            if time.monotonic() > deadline:
                raise CollectionStopped(f"The drives did not become enabled within {ENABLE_WITHIN:g} s.")
            time.sleep(0.01)
        self.start = self._next_sample().values[robot.command.signal]

    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        """See `Playground.play`."""
        end = time.monotonic() + duration
        while (now := time.monotonic()) < end:
            sample = self._next_sample()
            if (mode := self._mode()) not in ("hold", "follow"):
                raise CollectionStopped(f"The robot went to '{mode}'. `gemuco top {self._robot.robot}` may tell why.")
            self._client.command(self._robot.command.signal, command, sample)
            if now - self._recorded >= self._interval:
                self._recorded = now
                yield self._freshness.take()[1]

    def elapsed(self) -> float:
        """See `Playground.elapsed`."""
        return time.monotonic() - self._began

    def _next_sample(self) -> Sample:
        sample = self._samples.wait(self._robot.command.time_to_live)
        if sample is None:
            raise CollectionStopped("No sample comes from the HAL any more. Is `gemuco hal` running?")
        return sample

    def _mode(self) -> str:
        applied = self._client.applied(timeout=self._robot.command.time_to_live)
        return "off" if applied is None else applied.mode
