"""A small model of a robot, trained in seconds: for benchmarks of the processes, which do not ask how good it is."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gemuco.checkpoint import save
from gemuco.dataset import Dataset, Episode
from gemuco.learning.train import TrainConfig, fit
from hal.config import RobotConfig
from services.model import artifacts
from services.model.living_model import layout_of

PARTS = 10


def make(robot: RobotConfig, rows: Mapping[str, np.ndarray], masks: tuple[tuple[str, ...], ...], folder: Path) -> None:
    """Train and save.

    Args:
        robot: The robot file.
        rows: Signal -> samples [its unit], shape (count, n).
        masks: Sets of signals from which the others are estimated.
        folder: Where the model goes.
    """
    parts = np.array_split(np.arange(len(next(iter(rows.values())))), PARTS)
    episodes = tuple(Episode("", {name: value[part] for name, value in rows.items()}) for part in parts)
    config = TrainConfig(hidden=(40, 20), epochs=25, batch=200, rate=5e-3)
    schema, _ = fit(Dataset(layout_of(robot), episodes), config, masks)
    save(schema.with_manifest(fingerprint=artifacts.fingerprint(robot)), folder)
