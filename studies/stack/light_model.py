"""A small model of the light robot. It has its own file, because the robot's processes must not load training code."""

from pathlib import Path

import numpy as np

from gemuco import checkpoint
from gemuco.dataset import Dataset, Episode
from gemuco.learning.train import TrainConfig, fit
from hal.config import RobotConfig, load_robot
from services.learning import trainer
from services.model import artifacts
from services.model.living_model import layout_of
from studies.stack.light_robot import JOINT, JOINTS, LOAD, MOTOR, NOISE, RANGE, body

MASKS = ((MOTOR, LOAD), (JOINT, LOAD), (MOTOR, JOINT))


def states(config: RobotConfig, count: int, seed: int) -> dict[str, np.ndarray]:
    """Draw random states with noise: signal -> values [its unit], shape (count, 2)."""
    random = np.random.default_rng(seed)
    values = body(random.uniform(-RANGE, RANGE, (count, len(JOINTS))))
    return {name: values[name] + random.normal(0.0, NOISE[name], values[name].shape) for name in config.signals}


def make(file: Path, folder: Path) -> None:
    """Train a small model within seconds, unless the folder has a model that fits; it fits every light robot."""
    robot = load_robot(file)
    if trainer.fits(robot, folder):
        return
    rows = states(robot, 2000, 0)
    parts = np.array_split(np.arange(2000), 10)
    episodes = tuple(Episode("", {name: value[part] for name, value in rows.items()}) for part in parts)
    config = TrainConfig(hidden=(40, 20), epochs=25, batch=200, rate=5e-3)
    schema, _ = fit(Dataset(layout_of(robot), episodes), config, MASKS)
    checkpoint.save(schema.with_manifest(fingerprint=artifacts.fingerprint(robot)), folder)
