"""Random safe motion, recorded: without a bus as fast as it computes, or on a running robot in its own time."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from gemuco.dataset import Dataset, Episode
from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.robot import Robot
from services.client import Client
from services.errors import ServiceError
from services.living_model import layout_of
from services.model_config import CollectConfig, collect_config

EPISODE = 10.0
"""Length of an episode [s of the robot's time]: held-out data are whole episodes."""
MARGIN = 0.05
"""Share of the range between two limits by which a sample may lie outside."""
ENABLE_WITHIN = 5.0
"""Time [s] within which the drives must be enabled."""

Values = dict[str, np.ndarray]
Progress = Callable[[float, str], None]


class CollectionStopped(ServiceError):
    """The robot stopped before enough was recorded; the text says why."""


class Playground(Protocol):
    """A robot that can be moved and looked at."""

    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        """Hold a command [unit of the commanded signal], shape (n,), for so long [s]; yield what is to be recorded."""
        ...

    def elapsed(self) -> float:
        """The robot's own time [s]."""
        ...


@dataclass(frozen=True, slots=True)
class Collected:
    """What was recorded, and how long it took.

    Attributes:
        dataset: The episodes.
        robot_time: How long the robot moved [s].
        wall_time: How long that took [s].
    """

    dataset: Dataset
    robot_time: float
    wall_time: float

    @property
    def speed(self) -> float:
        """How many times faster than real time."""
        return self.robot_time / max(self.wall_time, 1e-9)


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
        self._start = self._next
        self._cycle = 0
        self._turn()
        robot.enable()
        for _ in range(round(ENABLE_WITHIN / robot.period)):
            self._turn()
            if robot.mode in ("hold", "follow"):
                return
        raise CollectionStopped(f"The drives did not become enabled within {ENABLE_WITHIN:g} s: mode '{robot.mode}'.")

    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        """See `Playground.play`."""
        for _ in range(max(1, round(duration / self._robot.period))):
            self._robot.command(command, self._cycle)
            sample = self._turn()
            if self._robot.mode == "fault":
                raise CollectionStopped(f"The robot stopped: {self._robot.fault_text}")
            if self._cycle % self._every == 0:
                yield sample

    def elapsed(self) -> float:
        """See `Playground.elapsed`."""
        return self._robot.clock.monotonic() - self._start

    def _turn(self) -> Values:
        sample, _ = self._robot.cycle()
        self._cycle = sample.cycle
        self._next += self._robot.period
        self._robot.clock.sleep_until(self._next)
        return sample.values


def gather(
    robot: RobotConfig,
    body: Playground,
    motion: Iterator[tuple[np.ndarray, float]],
    config: CollectConfig,
    condition: str,
    progress: Progress,
) -> Collected:
    """Play the motion until enough samples are recorded.

    Only samples in which every value is valid and within the robot file's limits count: beyond them, on a mechanical
    stop or with slack muscles, the signals do not say where the body is.
    """
    layout = layout_of(robot)
    low, high = _bounds(robot)
    per_episode = max(2, round(EPISODE * config.rate))
    started = time.monotonic()
    rows: list[np.ndarray] = []
    told = 0.0
    while len(rows) < config.samples:
        command, duration = next(motion)
        for values in body.play(command, duration):
            row = layout.join(values)
            if body.elapsed() >= config.settle and np.all((row >= low) & (row <= high)):
                rows.append(row)
        if time.monotonic() - told > 0.1:
            told = time.monotonic()
            speed = body.elapsed() / max(told - started, 1e-9)
            progress(min(1.0, len(rows) / config.samples), f"{len(rows)} samples, {speed:.0f} x real time")
    table = np.array(rows[: config.samples])
    parts = np.split(table, range(per_episode, len(table), per_episode))
    episodes = tuple(Episode(condition, layout.split(part)) for part in parts)
    return Collected(Dataset(layout, episodes), body.elapsed(), time.monotonic() - started)


def _bounds(robot: RobotConfig) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value that counts of every element, limits widened by a share of their range."""
    bounds = [robot.bounds(name) for name in robot.signals]
    low, high = (np.concatenate(part) for part in zip(*bounds, strict=True))
    margin = np.where(np.isfinite(high - low), MARGIN * (high - low), 0.0)
    return low - margin, high + margin


def collect_direct(robot: RobotConfig, variant: str, seed: int, samples: int | None, progress: Progress) -> Collected:
    """Record from the robot file's simulator without a bus; the first of its variants is the designer's.

    Raises:
        ConfigError: The robot file names no simulator or no motion.
        CollectionStopped: The robot stopped by itself.
    """
    config = _with_samples(collect_config(robot), samples)
    simulator = simulator_of(robot)
    if variant not in simulator.variants:
        known = ", ".join(simulator.variants)
        raise ConfigError(f"Robot '{robot.robot}' has no variant '{variant}'. Known variants: {known}.")
    motion = registry.load(config.motion)(robot, seed)
    with simulator.direct(robot, variant, seed) as body:
        found = gather(robot, DirectPlayground(body, config.rate), motion, config, variant, progress)
    is_designers = variant == simulator.variants[0]
    return found if config.states is None or not is_designers else _with_states(robot, config, found, seed)


def _with_states(robot: RobotConfig, config: CollectConfig, found: Collected, seed: int) -> Collected:
    """What was recorded, and random states of the designer's geometry in episodes of the same length and condition."""
    count = max(1, round(config.states_share * len(found.dataset)))
    states = registry.load(config.states or "")(robot, count, seed)
    condition = found.dataset.conditions[0]
    parts = np.split(np.arange(count), range(round(EPISODE * config.rate), count, round(EPISODE * config.rate)))
    added = tuple(Episode(condition, {name: rows[part] for name, rows in states.items()}) for part in parts)
    dataset = Dataset(found.dataset.layout, found.dataset.episodes + added)
    return replace(found, dataset=dataset)


def simulator_of(robot: RobotConfig) -> "Simulator":
    """What the robot file names as its simulator.

    Raises:
        ConfigError: It names none.
    """
    if robot.simulator is None:
        raise ConfigError(f"Robot '{robot.robot}' names no simulator; add `simulator: module:name` to its file.")
    return registry.load(robot.simulator)


class Simulator(Protocol):
    """What stands in for a robot, as far as services go into it."""

    variants: tuple[str, ...]

    def direct(self, config: RobotConfig, variant: str, seed: int) -> Robot:
        """The simulated robot without a bus; not opened yet."""
        ...


def _with_samples(config: CollectConfig, samples: int | None) -> CollectConfig:
    return config if samples is None else config.model_copy(update={"samples": samples})


class BusPlayground:
    """A running robot; its time is the wall's."""

    def __init__(self, robot: RobotConfig, client: Client, rate: float) -> None:
        """Enable the robot; `rate` [Hz] is how often a sample is recorded.

        Raises:
            ServiceUnavailable: No HAL answers.
            CommandRefused: It does not enable.
            CollectionStopped: The drives do not come.
        """
        self._robot, self._client = robot, client
        self._interval = 1.0 / rate
        self._start = self._recorded = time.monotonic()
        deadline = time.monotonic() + ENABLE_WITHIN
        client.enable()
        while self._mode() not in ("hold", "follow"):
            if time.monotonic() > deadline:
                raise CollectionStopped(f"The drives did not become enabled within {ENABLE_WITHIN:g} s.")
            time.sleep(0.01)

    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        """See `Playground.play`."""
        end = time.monotonic() + duration
        while (now := time.monotonic()) < end:
            sample = self._client.next_sample(self._robot.command.time_to_live)
            if sample is None:
                raise CollectionStopped("No sample comes from the HAL any more. Is `gemuco hal` running?")
            if (mode := self._mode()) not in ("hold", "follow"):
                raise CollectionStopped(f"The robot went to '{mode}'. `gemuco top {self._robot.robot}` may tell why.")
            self._client.command(self._robot.command.signal, command, sample)
            if now - self._recorded >= self._interval:
                self._recorded = now
                yield dict(sample.values)

    def elapsed(self) -> float:
        """See `Playground.elapsed`."""
        return time.monotonic() - self._start

    def _mode(self) -> str:
        applied = self._client.applied(timeout=self._robot.command.time_to_live)
        return "off" if applied is None else applied.mode


def collect_bus(robot: RobotConfig, seed: int, samples: int | None, progress: Progress) -> Collected:
    """Record from the robot that a HAL runs, as a client of it, and let it go at the end.

    Raises:
        ConfigError: The robot file names no motion.
        ServiceUnavailable: No HAL answers.
        CollectionStopped: The robot stopped by itself.
    """
    config = _with_samples(collect_config(robot), samples)
    motion = registry.load(config.motion)(robot, seed)
    with Client(robot.robot) as client:
        try:
            return gather(robot, BusPlayground(robot, client, config.rate), motion, config, "bus", progress)
        finally:
            client.disable()
