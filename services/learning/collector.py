"""Safe motion, recorded: random or taught, condition by condition, without a bus or on a running robot."""

import time
from collections.abc import Callable, Sequence
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

EPISODE = 10.0
"""Length of an episode [s of the robot's time]: held-out data are whole episodes."""
MARGIN = 0.05
"""Share of the range between two limits by which a sample may lie outside."""
STARVED = 30.0
"""Robot time [s] without a sample that counts, after which collecting is given up."""
BUS = "bus"
"""Condition of what was recorded on a bus, of a robot whose file has no conditions, if none was told."""

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to record, where the robot file leaves a choice.

    Attributes:
        conditions: Names of conditions; all of the robot file's if empty.
        samples: Per condition; the robot file's number, or all of the taught postures, if None.
        postures: A CSV file of taught postures to play, in place of random motion.
    """

    conditions: Sequence[str] = ()
    samples: int | None = None
    postures: Path | None = None


EVERYTHING = Wanted()


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


def _quiet(share: float, text: str) -> None:
    """Tell nobody."""


def collect_direct(
    robot: RobotConfig,
    variant: str | None = None,
    seed: int = 0,
    wanted: Wanted = EVERYTHING,
    progress: Progress = _quiet,
) -> Collected:
    """Record from the robot file's simulator without a bus, under one condition after the other.

    Args:
        robot: The robot file.
        variant: Of the simulator; the designer's if None.
        seed: Chooses the robot among those of the variant, its noise, and the motion.
        wanted: What to record.
        progress: Told the share done, 0 to 1, and a line of text.

    Raises:
        ConfigError: The robot file names no simulator, or cannot be moved; an unknown variant or condition.
        BadPostures, NowhereToGo, CollectionStopped: Nothing, or not enough, was recorded.
    """
    config, simulator = collect_config(robot), simulator_of(robot)
    variant = variant_of(robot, variant)
    # Each once: the same motion again would be in the data twice, and held out from itself.
    chosen = dict.fromkeys(wanted.conditions or robot.conditions or (None,))
    conditions = [condition_of(robot, one) for one in chosen]
    motions = [_motion(robot, config, condition, seed, wanted) for condition in conditions]
    found: list[Collected] = []
    for index, condition in enumerate(conditions):

        def tell(share: float, text: str, index: int = index, condition: str | None = condition) -> None:
            progress((index + share) / len(conditions), text if condition is None else f"{condition}: {text}")

        with simulator.direct(robot, variant, seed, condition) as body:
            place = DirectPlayground(body, config.rate)
            found.append(_gather(robot, place, motions[index], config, wanted, condition or variant, tell))
    whole = _joined(found)
    if config.states is None or variant != simulator.variants[0] or wanted.postures is not None:
        return whole
    return _with_states(robot, config, whole, seed)


def collect_bus(
    robot: RobotConfig, seed: int = 0, wanted: Wanted = EVERYTHING, progress: Progress = _quiet
) -> Collected:
    """Record from the robot that a HAL runs, as a client of it, and let it go at the end.

    Args:
        robot: The robot file.
        seed: Of the motion.
        wanted: What to record; of conditions at most one, any name, for what the body holds while it is recorded.
        progress: Told the share done, 0 to 1, and a line of text.

    Raises:
        ConfigError: The robot file does not say how to move.
        ServiceUnavailable: No HAL answers.
        CommandHeld, LeaseLost: Somebody else commands the robot.
        BadPostures, NowhereToGo, CollectionStopped: Nothing, or not enough, was recorded.
    """
    if len(wanted.conditions) > 1:
        raise CollectionStopped(
            f"A running robot is under one condition at a time, not {', '.join(wanted.conditions)}: collect each by "
            "itself, and change the tool in between."
        )
    config = collect_config(robot)
    told = wanted.conditions[0] if wanted.conditions else None
    condition = condition_of(robot, told if told in robot.conditions else None)
    motion = _motion(robot, config, condition, seed, wanted)
    with Client(robot.robot) as client, client.lease():
        try:
            place = BusPlayground(robot, client, config.rate)
            return _gather(robot, place, motion, config, wanted, told or condition or BUS, progress)
        finally:
            client.disable()


def _motion(robot: RobotConfig, config: CollectConfig, condition: str | None, seed: int, wanted: Wanted) -> Motion:
    if wanted.postures is not None:
        return taught(robot, config, load_postures(wanted.postures, robot, config.hold))
    if config.motion is not None:
        own = registry.load(config.motion)
        return lambda start: own(robot, seed)
    return random_postures(robot, config, condition, seed)


def _gather(
    robot: RobotConfig,
    body: Playground,
    motion: Motion,
    config: CollectConfig,
    wanted: Wanted,
    condition: str,
    progress: Progress,
) -> Collected:
    """Play the motion until enough samples are recorded, or to its end."""
    table = _Table(robot, config, condition)
    started = time.monotonic()
    most = wanted.samples
    if most is None and wanted.postures is None:
        most = config.samples
    told = 0.0
    for command, duration in motion(body.start):
        for values in body.play(command, duration):
            table.add(values, body.elapsed())
        if time.monotonic() - told > 0.1:
            told = time.monotonic()
            speed = body.elapsed() / max(told - started, 1e-9)
            progress(len(table.rows) / most if most else 0.5, f"{len(table.rows)} samples, {speed:.0f} x real time")
        if most is not None and len(table.rows) >= most:
            break
    return Collected(table.dataset(most), body.elapsed(), time.monotonic() - started)


class Within:
    """Which values count.

    A value that a device measures must be there and within the robot file's limits: beyond them, on a mechanical stop
    or with slack muscles, the signals do not say where the body is. What a camera sees may be missing.

    Attributes:
        low: Least value that counts of every element [its unit], shape (layout.size,).
        high: Greatest value that counts, likewise.
    """

    def __init__(self, robot: RobotConfig, layout: Layout) -> None:
        bounds = [robot.bounds(name) for name in layout.names]
        low, high = (np.concatenate(part) for part in zip(*bounds, strict=True))
        margin = np.where(np.isfinite(high - low), MARGIN * (high - low), 0.0)
        self.low, self.high = low - margin, high + margin
        sizes = [signal.size for signal in layout.signals]
        self._may_miss = np.repeat([name in robot.seen for name in layout.names], sizes)

    def counts(self, row: np.ndarray) -> np.ndarray:
        """Whether each value of a sample [unit], shape (layout.size,), counts."""
        return ((row >= self.low) & (row <= self.high)) | (self._may_miss & np.isnan(row))


class _Table:
    """The rows that count."""

    def __init__(self, robot: RobotConfig, config: CollectConfig, condition: str) -> None:
        self._config, self._condition = config, condition
        self._layout: Layout = layout_of(robot)
        self._within = Within(robot, self._layout)
        self._fed = config.settle
        self.rows: list[np.ndarray] = []

    def add(self, values: Values, elapsed: float) -> None:
        """Take a sample at the robot's time [s] if it counts.

        Raises:
            CollectionStopped: None has counted for long.
        """
        if elapsed < self._config.settle:
            return
        row = self._layout.join({name: values[name] for name in self._layout.names if name in values})
        counts = self._within.counts(row)
        if counts.all():
            self.rows.append(row)
            self._fed = elapsed
        elif elapsed - self._fed > STARVED:
            index, within = int(np.argmin(counts)), self._within
            raise CollectionStopped(
                f"No sample counted for {STARVED:g} s: {self._layout.element(index)} is {row[index]:.4g}, and must be "
                f"measured, from {within.low[index]:.4g} to {within.high[index]:.4g}. {len(self.rows)} were recorded."
            )

    def dataset(self, most: int | None) -> Dataset:
        """At most so many rows, in episodes.

        Raises:
            CollectionStopped: There is none.
        """
        if not self.rows:
            raise CollectionStopped("The motion ended before a sample was recorded. Is it too short for collect.rate?")
        table = np.array(self.rows[:most])
        per_episode = max(2, round(EPISODE * self._config.rate))
        parts = np.split(table, range(per_episode, len(table), per_episode))
        return Dataset(self._layout, tuple(Episode(self._condition, self._layout.split(part)) for part in parts))


def _joined(parts: Sequence[Collected]) -> Collected:
    episodes = tuple(episode for part in parts for episode in part.dataset.episodes)
    dataset = Dataset(parts[0].dataset.layout, episodes)
    return Collected(dataset, sum(part.robot_time for part in parts), sum(part.wall_time for part in parts))


def _with_states(robot: RobotConfig, config: CollectConfig, found: Collected, seed: int) -> Collected:
    """What was recorded, and random states of the designer's geometry in episodes of the same length and condition."""
    count = max(1, round(config.states_share * len(found.dataset)))
    states = registry.load(config.states or "")(robot, count, seed)
    condition = found.dataset.conditions[0]
    parts = np.split(np.arange(count), range(round(EPISODE * config.rate), count, round(EPISODE * config.rate)))
    added = tuple(Episode(condition, {name: rows[part] for name, rows in states.items()}) for part in parts)
    dataset = Dataset(found.dataset.layout, found.dataset.episodes + added)
    return replace(found, dataset=dataset)
