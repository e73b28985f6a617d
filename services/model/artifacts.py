"""Paths of a robot's data and model, and the fingerprint that links a model to a robot file."""

import hashlib
import json
from pathlib import Path

from hal.config import RobotConfig
from hal.errors import ConfigError
from services.model.model_config import model_config

RUNS = Path("runs")
ROBOTS = Path("robots")


def data_path(robot: str) -> Path:
    """Return the path of the collected episodes."""
    return RUNS / robot / "data.npz"


def model_folder(robot: str) -> Path:
    """Return the folder of the trained body schema."""
    return RUNS / robot / "model"


def fingerprint(robot: RobotConfig) -> str:
    """Hash the parts of the robot file that a model depends on: signals, conditions, collection and training."""
    model = model_config(robot)
    content = {
        "signals": {name: list(robot.signals[name].elements) for name in model.signals or robot.signals},
        "conditions": list(robot.conditions),
        "collect": robot.collect,
        "model": [part.model_dump() for part in (model.network, model.structure, model.training)],
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def robot_file(text: str) -> Path:
    """Return the path of a robot file, given its path or the robot's name (`musashi_arm`).

    Raises:
        ConfigError: There is no such file.
    """
    path = Path(text)
    if path.suffix in (".yaml", ".yml") or path.exists():
        return path
    named = ROBOTS / f"{text}.yaml"
    if named.exists():
        return named
    known = ", ".join(sorted(file.stem for file in ROBOTS.glob("*.yaml") if "." not in file.stem)) or "none"
    raise ConfigError(f"There is no robot '{text}'. Known in {ROBOTS}/: {known}; or give the path of a robot file.")
