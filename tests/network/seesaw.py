"""The robot of the campaign: one joint between two muscles, on simulated buses, and a model of it that can control it.

Small enough that HAL, model and everything around them run on two busy cores; the joint follows from the lengths of
the muscles, so what the controller does can be seen.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gemuco.checkpoint import save

sys.path.append(str(Path(__file__).parents[1] / "services"))
import small_arm

from hal.config import RobotConfig
from services.model.artifacts import fingerprint
from services.model.living_model import layout_of
from simulators.rig import Rig

LEVER = 0.02
"""Of both muscles at the joint [m]."""
SOFTNESS = 0.001
"""Stretch of a muscle [m/N]."""
SLACK = 0.03
"""Stretch of each muscle at length 0 and angle 0 [m]."""
RATE = 100.0
TIME_TO_LIVE = 0.15
HOLD = 0.5
STALE = 0.05
MASKS = (("muscle_length",), ("joint_position", "muscle_tension"))


def description(robot: str) -> dict[str, Any]:
    """A robot file as a mapping."""
    found = small_arm.description(robot)
    for signal in found["signals"].values():
        signal["stale_after"] = STALE
    found["command"] |= {"time_to_live": TIME_TO_LIVE, "hold": HOLD}
    found["limits"]["muscle_length"] = {"low": -0.05, "high": 0.05, "rate": 0.25}
    found["rates"] = {"hal": RATE, "estimation": RATE, "control": 50, "anomaly": 20, "update": 2}
    found["simulator"] = "seesaw:simulator"
    found["model"] = {
        "control": {
            "target": "joint_position",
            "speed": 0.15,
            "route": "input",
            "mask": ["joint_position", "muscle_tension"],
            "terms": [{"match": "joint_position"}, {"stay_small": "muscle_tension", "weight": 0.1}],
        }
    }
    return found


def statics(lengths: np.ndarray) -> dict[str, np.ndarray]:
    """Signal -> values in balance, shape (k, n), at muscle lengths [m], shape (k, 2)."""
    joint = (lengths[:, 1] - lengths[:, 0]) / (2 * LEVER)
    force = np.maximum((2 * SLACK - lengths.sum(axis=1)) / (2 * SOFTNESS), 0.0)
    return {
        "joint_position": joint[:, None],
        "muscle_tension": np.stack([force, force], axis=1),
        "muscle_length": lengths.copy(),
    }


def train(robot: RobotConfig, folder: Path) -> None:
    """Make a model of the robot, in seconds."""
    from gemuco.dataset import Dataset, Episode
    from gemuco.learning.train import TrainConfig, fit

    chance = np.random.default_rng(0)
    joint, force = chance.uniform(-1, 1, 3000), chance.uniform(10, 60, 3000)
    lengths = np.stack([-LEVER * joint, LEVER * joint], axis=1) + (SLACK - SOFTNESS * force)[:, None]
    rows = statics(lengths)
    noisy = {name: value + chance.normal(0, 0.003 * value.std(), value.shape) for name, value in rows.items()}
    episodes = [
        Episode("", {name: value[part] for name, value in noisy.items()}) for part in np.split(np.arange(3000), 10)
    ]
    config = TrainConfig(hidden=(40, 20), epochs=30, batch=200, rate=5e-3)
    schema = fit(Dataset(layout_of(robot), tuple(episodes)), config, MASKS)[0]
    save(schema.with_manifest(fingerprint=fingerprint(robot)), folder)


class SeesawWorld(small_arm.WireWorld):
    """Muscles whose lengths follow their servos, and a joint in balance between them."""

    def measure(self) -> Mapping[str, np.ndarray]:
        return {name: value[0] for name, value in statics(self._length[None].copy()).items()}

    truth = measure


class Seesaw(small_arm.SmallArm):
    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        return Rig(config, SeesawWorld(), small_arm._hardware())


simulator = Seesaw()
