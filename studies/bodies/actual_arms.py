"""The trained model of the muscle-driven arm, and random motion of its actual variants."""

import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np
from rich.console import Console

from gemuco.checkpoint import save
from gemuco.dataset import Dataset
from gemuco.schema import BodySchema
from hal import registry
from hal.config import RobotConfig
from hal.robot import Robot
from services.learning import collector, trainer
from services.learning.playground import DirectPlayground
from services.model import artifacts
from services.model.living_model import load_model
from simulators.direct import DirectDevice, WorldClock


def motion(
    robot: RobotConfig, body: Robot, seed: int, rate: float, duration: float, rests_at: float = math.inf
) -> Iterator[Mapping[str, np.ndarray]]:
    """Yield samples [unit] at a rate [Hz] of random motion that lasts `duration` [s of the arm's time].

    From the time `rests_at` [s] on the arm gets no new command, and comes to rest.
    """
    playground = DirectPlayground(body, rate)
    for command, hold in registry.load_object(robot.collect["motion"])(robot, seed):
        yield from playground.play(command, hold)
        if playground.elapsed() > rests_at:
            yield from playground.play(command, duration - playground.elapsed())
        if playground.elapsed() > duration:
            return


Contact = Callable[[float, np.ndarray], np.ndarray]
"""Joint torques [N m] of contacts at a time [s] and at joint positions [rad], shapes (n,)."""


def record(
    robot: RobotConfig,
    arm: int,
    seed: int,
    rate: float,
    duration: float,
    part: str = "",
    contact: Contact | None = None,
    breaks_at: float = 0.0,
    rests_at: float = math.inf,
) -> dict[str, np.ndarray]:
    """Return signal -> samples (count, n) [unit] of one actual arm, of which a part breaks at a time [s].

    It moves at random until the time `rests_at` [s].
    """
    world = registry.load_object(robot.simulator or "", "simulator", ("world",)).world("actual", arm)
    if part and not breaks_at:
        world.break_part(part)
    if contact is not None:
        world.push = lambda position: contact(world.time, position)
    clock = WorldClock(world)
    with Robot(robot, [DirectDevice(robot, world, clock)], clock=clock, source="simulated") as body:
        rows = []
        for row in motion(robot, body, seed, rate, duration, rests_at):
            rows.append(row)
            if part and breaks_at and len(rows) == round(breaks_at * rate):
                world.break_part(part)
    return {name: np.array([row[name] for row in rows]) for name in robot.signals}


def model(robot: RobotConfig, console: Console) -> BodySchema:
    """Load the trained model of the robot; collect and train first if it is missing."""
    folder = artifacts.model_folder(robot.robot)
    if not folder.exists():
        console.print("collecting and training")
        data = artifacts.data_path(robot.robot)
        if not data.exists():
            collector.collect_direct(robot, "geometric", 0).dataset.save(data)
        save(trainer.train(robot, Dataset.load(data), 0, lambda *_: None).schema, folder)
    return load_model(robot, folder)
