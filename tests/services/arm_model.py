"""A small model of the shipped arm, trained in seconds from the designer's geometry; and samples of that geometry."""

from functools import cache
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.learning.train import TrainConfig, fit
from gemuco.schema import BodySchema
from hal.config import RobotConfig, load_robot
from services.model.living_model import layout_of
from services.wire.messages import Sample
from services.wire.streams import Arrival
from simulators.robots.musashi_arm.motion import random_states

ROBOT = Path(__file__).parents[2] / "robots" / "musashi_arm.yaml"
MASKS = (("muscle_tension", "muscle_length"), ("joint_position", "muscle_tension"))


@cache
def arm() -> RobotConfig:
    return load_robot(ROBOT)


@cache
def states(count: int = 3000, seed: int = 0) -> dict[str, np.ndarray]:
    """Signal -> values of the geometric arm, shape (count, n)."""
    return random_states(arm(), count, seed)


@cache
def small_model(most: float = np.inf) -> BodySchema:
    """Train on the states in which the first joint is at most at an angle [rad]."""
    rows = states()
    kept = rows["joint_position"][:, 0] <= most
    rows = {name: values[kept] for name, values in rows.items()}
    layout = layout_of(arm())
    parts = np.split(np.arange(len(rows["joint_position"])), 10)
    dataset = Dataset(layout, tuple(Episode("", {name: value[part] for name, value in rows.items()}) for part in parts))
    config = TrainConfig(hidden=(60, 30), epochs=25, batch=200, rate=5e-3)
    return fit(dataset, config, MASKS)[0]


def sample_of(index: int, cycle: int = 1, silent: tuple[str, ...] = (), seed: int = 0) -> Sample:
    """A sample of one state; silent elements (`joint_position.elbow_pitch`) are not valid."""
    robot = arm()
    values = {name: np.array(value[index], float) for name, value in states(seed=seed).items()}
    valid = {name: np.ones(len(value), bool) for name, value in values.items()}
    for element in silent:
        name, part = element.split(".")
        place = robot.signals[name].elements.index(part)
        values[name][place], valid[name][place] = np.nan, False
    age = {name: np.full(len(value), 0.001) for name, value in values.items()}
    return Sample(cycle=cycle, boot=7, source="simulated", complete=not silent, values=values, age=age, valid=valid)


def fresh(index: int, received: float, cycle: int = 1, silent: tuple[str, ...] = (), seed: int = 0) -> Arrival[Sample]:
    return Arrival(sample_of(index, cycle, silent, seed), received)
