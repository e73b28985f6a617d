"""Recording of safe motion: random or taught, condition by condition, without a bus or on a running robot."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout
from hal import registry
from hal.config import RobotConfig
from services.client import Client
from services.hardware.stand_in import condition_of, simulator_of, variant_of
from services.learning.motion import Motion, random_postures
from services.learning.playground import BusPlayground, CollectionStopped, DirectPlayground, Playground, Values
from services.learning.postures import load_postures, taught
from services.model.living_model import layout_of
from services.model.model_config import CollectConfig, collect_config
from services.show import Progress

EPISODE = 10.0
"""An episode has this length [s of the robot's time]; held-out data are whole episodes."""
MARGIN = 0.05
"""A sample may exceed its limits by this share of their range."""
STARVED = 30.0
"""Collecting stops after this robot time [s] without a usable sample."""
ENOUGH = 100.0
"""Without a bus the robot has at most about this number of cycles per second [Hz]; more cost time. The samples of
Musashi then differ by 0.02 of their standard deviation from those at its 200 Hz."""
BUS = "bus"
"""Data recorded on a bus have this condition if neither the robot file nor the request names a condition."""


@dataclass(frozen=True, slots=True)
class Request:
    """Choices for a recording that the robot file leaves open.

    Attributes:
        conditions: Names of conditions; all of the robot file's if empty.
        samples: Samples per condition; if None, the number of the robot file, or all taught postures.
        postures: A CSV file of taught postures to play in place of random motion.
    """

    conditions: Sequence[str] = ()
    samples: int | None = None
    postures: Path | None = None


EVERYTHING = Request()


@dataclass(frozen=True, slots=True)
class Collection:
    """Recorded episodes and the time that they took.

    Attributes:
        dataset: The episodes.
        robot_time: Time that the robot moved [s].
        wall_time: Time that the recording took [s].
    """

    dataset: Dataset
    robot_time: float
    wall_time: float

    @property
    def speed(self) -> float:
        """Ratio to real time."""
        return self.robot_time / max(self.wall_time, 1e-9)


def _quiet(share: float, text: str) -> None:
    """Report no progress."""


def collect_direct(
    robot: RobotConfig,
    variant: str | None = None,
    seed: int = 0,
    request: Request = EVERYTHING,
    progress: Progress = _quiet,
) -> Collection:
    """Record from the robot file's simulator without a bus, under one condition after the other.

    Args:
        robot: The robot file.
        variant: Variant of the simulator; the designer's if None.
        seed: Seed of the robot of this variant, its noise, and the motion.
        request: Conditions, number of samples and postures to record.
        progress: Called with the share done, 0 to 1, and a line of text.

    Raises:
        ConfigError: The robot file names no simulator or no motion, or the variant or a condition is unknown.
        BadPostures, NowhereToGo, CollectionStopped: Too few samples were recorded.
    """
    config, simulator = collect_config(robot), simulator_of(robot)
    variant = variant_of(robot, variant)
    # Each condition once: otherwise the held-out data could repeat a motion of the training data.
    names = dict.fromkeys(request.conditions or robot.conditions or (None,))
    conditions = [condition_of(robot, name) for name in names]
    motions = [_motion(robot, config, condition, seed, request) for condition in conditions]
    parts: list[Collection] = []
    for index, condition in enumerate(conditions):

        def report(share: float, text: str, index: int = index, condition: str | None = condition) -> None:
            progress((index + share) / len(conditions), text if condition is None else f"{condition}: {text}")

        with simulator.direct(_slowed(robot, config.rate), variant, seed, condition) as body:
            place = DirectPlayground(body, config.rate)
            parts.append(_gather(robot, place, motions[index], config, request, condition or variant, report))
    whole = _joined(parts)
    if config.states is None or variant != simulator.variants[0] or request.postures is not None:
        return whole
    return _with_states(robot, config, whole, seed)


def _slowed(robot: RobotConfig, rate: float) -> RobotConfig:
    """Return the robot with about `ENOUGH` cycles per second, a multiple of the rate of the samples [Hz].

    A robot whose commands live for less than three of these cycles keeps its own rate.
    """
    cycles = min(robot.rates.hal, rate * math.ceil(ENOUGH / rate))
    if robot.command.time_to_live < 3.0 / cycles:
        return robot
    return robot.model_copy(update={"rates": robot.rates.model_copy(update={"hal": cycles})})


def collect_bus(
    robot: RobotConfig, seed: int = 0, request: Request = EVERYTHING, progress: Progress = _quiet
) -> Collection:
    """Record as a client of a running HAL, and disable the robot at the end.

    Args:
        robot: The robot file.
        seed: Seed of the motion.
        request: As for `collect_direct`, with at most one condition of any name, that of the body during the recording.
        progress: Called with the share done, 0 to 1, and a line of text.

    Raises:
        ConfigError: The robot file has no motion.
        ServiceUnavailable: No HAL answers.
        CommandHeld, LeaseLost: Another client commands the robot.
        BadPostures, NowhereToGo, CollectionStopped: Too few samples were recorded.
    """
    if len(request.conditions) > 1:
        raise CollectionStopped(
            f"A running robot has one condition at a time, not {', '.join(request.conditions)}: collect each condition "
            "separately, and change the tool between them."
        )
    config = collect_config(robot)
    name = request.conditions[0] if request.conditions else None
    condition = condition_of(robot, name if name in robot.conditions else None)
    motion = _motion(robot, config, condition, seed, request)
    with Client(robot.robot) as client, client.lease():
        try:
            place = BusPlayground(robot, client, config.rate)
            return _gather(robot, place, motion, config, request, name or condition or BUS, progress)
        finally:
            client.disable()


def motion_of(robot: RobotConfig, seed: int) -> Motion:
    """Return the motion that a recording of the robot plays under its first condition.

    Raises:
        ConfigError: The robot file has no motion.
    """
    return _motion(robot, collect_config(robot), condition_of(robot, None), seed, EVERYTHING)


def _motion(robot: RobotConfig, config: CollectConfig, condition: str | None, seed: int, request: Request) -> Motion:
    if request.postures is not None:
        return taught(robot, config, load_postures(request.postures, robot, config.hold))
    if config.motion is not None:
        own = registry.load_object(config.motion)
        return lambda start: own(robot, seed)
    return random_postures(robot, config, condition, seed)


def _gather(
    robot: RobotConfig,
    body: Playground,
    motion: Motion,
    config: CollectConfig,
    request: Request,
    condition: str,
    progress: Progress,
) -> Collection:
    """Play the motion until enough samples are recorded, or to its end."""
    table = _Table(robot, config, condition)
    started = time.monotonic()
    limit = request.samples
    if limit is None and request.postures is None:
        limit = config.samples
    reported = 0.0
    for command, duration in motion(body.start):
        for values in body.play(command, duration):
            table.add(values, body.elapsed())
        if time.monotonic() - reported > 0.1:
            reported = time.monotonic()
            speed = body.elapsed() / max(reported - started, 1e-9)
            progress(len(table.rows) / limit if limit else 0.5, f"{len(table.rows)} samples, {speed:.0f} x real time")
        if limit is not None and len(table.rows) >= limit:
            break
    return Collection(table.dataset(limit), body.elapsed(), time.monotonic() - started)


class SampleLimits:
    """Limits of usable values.

    A value of a device must be measured and within the robot file's limits. Outside of them (on a mechanical stop, or
    with slack muscles) the signals do not determine the posture. Values of a camera may be missing.

    Attributes:
        low: Least usable value of every element [its unit], shape (layout.size,).
        high: Greatest usable value of every element [its unit], shape (layout.size,).
    """

    def __init__(self, robot: RobotConfig, layout: Layout) -> None:
        bounds = [robot.bounds(name) for name in layout.names]
        low, high = (np.concatenate(part) for part in zip(*bounds, strict=True))
        margin = np.where(np.isfinite(high - low), MARGIN * (high - low), 0.0)
        self.low, self.high = low - margin, high + margin
        sizes = [signal.size for signal in layout.signals]
        self._may_miss = np.repeat([name in robot.seen for name in layout.names], sizes)

    def usable(self, row: np.ndarray) -> np.ndarray:
        """Return which values of a sample [unit] are usable, booleans, shape (layout.size,)."""
        return ((row >= self.low) & (row <= self.high)) | (self._may_miss & np.isnan(row))


class _Table:
    """Table of usable samples."""

    def __init__(self, robot: RobotConfig, config: CollectConfig, condition: str) -> None:
        self._config, self._condition = config, condition
        self._layout: Layout = layout_of(robot)
        self._limits = SampleLimits(robot, self._layout)
        self._last_usable = config.settle
        self.rows: list[np.ndarray] = []

    def add(self, values: Values, elapsed: float) -> None:
        """Add a sample if it is usable; `elapsed` is the robot's time [s].

        Raises:
            CollectionStopped: No sample was usable for `STARVED`.
        """
        if elapsed < self._config.settle:
            return
        row = self._layout.join({name: values[name] for name in self._layout.names if name in values})
        usable = self._limits.usable(row)
        if usable.all():
            self.rows.append(row)
            self._last_usable = elapsed
        elif elapsed - self._last_usable > STARVED:
            index, limits = int(np.argmin(usable)), self._limits
            raise CollectionStopped(
                f"No sample was usable for {STARVED:g} s: {self._layout.element(index)} is {row[index]:.4g}, and must "
                f"be measured, from {limits.low[index]:.4g} to {limits.high[index]:.4g}. {len(self.rows)} samples were "
                "recorded."
            )

    def dataset(self, limit: int | None) -> Dataset:
        """Return at most `limit` rows as episodes.

        Raises:
            CollectionStopped: The table is empty.
        """
        if not self.rows:
            raise CollectionStopped("The motion ended before a sample was recorded. Is it too short for collect.rate?")
        table = np.array(self.rows[:limit])
        per_episode = max(2, round(EPISODE * self._config.rate))
        parts = np.split(table, range(per_episode, len(table), per_episode))
        return Dataset(self._layout, tuple(Episode(self._condition, self._layout.split(part)) for part in parts))


def _joined(parts: Sequence[Collection]) -> Collection:
    episodes = tuple(episode for part in parts for episode in part.dataset.episodes)
    dataset = Dataset(parts[0].dataset.layout, episodes)
    return Collection(dataset, sum(part.robot_time for part in parts), sum(part.wall_time for part in parts))


def _with_states(robot: RobotConfig, config: CollectConfig, recorded: Collection, seed: int) -> Collection:
    """Return a recording with random states of the designer's geometry added, in episodes of the same length."""
    count = max(1, round(config.states_share * len(recorded.dataset)))
    states = registry.load_object(config.states or "")(robot, count, seed)
    condition = recorded.dataset.conditions[0]
    parts = np.split(np.arange(count), range(round(EPISODE * config.rate), count, round(EPISODE * config.rate)))
    added = tuple(Episode(condition, {name: rows[part] for name, rows in states.items()}) for part in parts)
    dataset = Dataset(recorded.dataset.layout, recorded.dataset.episodes + added)
    return replace(recorded, dataset=dataset)
