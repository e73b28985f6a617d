"""Robots to record from: a simulated robot without a bus, at full speed, or a running robot in real time."""

import time
from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np
from typing_extensions import override

from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.robot import Robot
from services.client import Client
from services.errors import ServiceError
from services.model.estimation import Freshness, OneTime
from services.wire import keys
from services.wire.messages import Sample

ENABLE_WITHIN = 5.0
"""The drives must be enabled within this time [s]."""

Values = Mapping[str, np.ndarray]


class CollectionStopped(ServiceError):
    """The robot stopped before enough samples were recorded; the text gives the reason."""


class Playground(Protocol):
    """Robot that can be moved and recorded."""

    start: np.ndarray
    """Position of the robot when it was enabled [unit of the commanded signal], shape (k,)."""

    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        """Hold a command [unit of the commanded signal], shape (k,), for `duration` [s]; yield samples to record."""
        ...

    def elapsed(self) -> float:
        """Return the robot's own time [s]."""
        ...


class DirectPlayground(Playground):
    """Simulated robot without a bus; its time is the simulation's."""

    def __init__(self, robot: Robot, rate: float) -> None:
        """Enable the robot; samples are recorded at `rate` [Hz].

        Raises:
            CollectionStopped: The drives were not enabled in time.
        """
        self._robot = robot
        self._every = max(1, round(1.0 / (rate * robot.period)))
        self._next = robot.clock.monotonic()
        self._began = self._next
        self._cycle = 0
        self.start = self._run_cycle()[robot.config.command.signal].copy()
        robot.enable()
        for _ in range(round(ENABLE_WITHIN / robot.period)):
            self._run_cycle()
            if robot.mode in ("hold", "follow"):
                return
        raise CollectionStopped(f"The drives did not become enabled within {ENABLE_WITHIN:g} s: mode '{robot.mode}'.")

    @override
    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        robot = self._robot
        for _ in range(max(1, round(duration / robot.period))):
            robot.command(command, self._cycle)
            sample = self._run_cycle()
            if robot.mode == "fault":
                raise CollectionStopped(f"The robot stopped: {robot.fault_text}")
            if self._cycle % self._every == 0:
                yield sample

    @override
    def elapsed(self) -> float:
        return self._robot.clock.monotonic() - self._began

    def _run_cycle(self) -> Values:
        sample, _ = self._robot.cycle()
        self._cycle = sample.cycle
        self._next += self._robot.period
        self._robot.clock.sleep_until(self._next)
        return sample.values


class BusPlayground(Playground):
    """Running robot, with its camera if it has one, in real time."""

    def __init__(self, robot: RobotConfig, client: Client, rate: float) -> None:
        """Enable the robot; samples are recorded at `rate` [Hz].

        Raises:
            ServiceUnavailable: No HAL answers.
            CommandRefused: The HAL refuses to enable.
            CollectionStopped: The drives were not enabled in time.
        """
        self._robot, self._client = robot, client
        self._interval = 1.0 / rate
        self._samples = client.reader(keys.sample(robot.robot), Sample)
        seen = client.reader(keys.vision(robot.robot), Sample)
        freshness = Freshness(robot, self._samples.last, SystemClock(), seen.last if robot.seen else None)
        self._one_time = OneTime(freshness)
        self._began = self._recorded = time.monotonic()
        deadline = time.monotonic() + ENABLE_WITHIN
        client.enable()
        while self._mode() not in ("hold", "follow"):
            if time.monotonic() > deadline:
                raise CollectionStopped(f"The drives did not become enabled within {ENABLE_WITHIN:g} s.")
            time.sleep(0.01)
        self.start = self._next_sample().values[robot.command.signal]

    @override
    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        end = time.monotonic() + duration
        while (now := time.monotonic()) < end:
            sample = self._next_sample()
            if (mode := self._mode()) not in ("hold", "follow"):
                raise CollectionStopped(
                    f"The robot went to '{mode}'. `gemuco top {self._robot.robot}` may show the reason."
                )
            self._client.command(self._robot.command.signal, command, sample)
            rows = self._one_time.rows(now)
            if rows and now - self._recorded >= self._interval:
                self._recorded = now
                yield rows[-1]

    @override
    def elapsed(self) -> float:
        return time.monotonic() - self._began

    def _next_sample(self) -> Sample:
        sample = self._samples.wait(self._robot.command.time_to_live)
        if sample is None:
            raise CollectionStopped("No sample comes from the HAL any more. Is `gemuco hal` running?")
        return sample

    def _mode(self) -> str:
        applied = self._client.applied(timeout=self._robot.command.time_to_live)
        return "off" if applied is None else applied.mode
