"""Where a robot's data, model and recordings lie, and whether a model was made for a robot file."""

import hashlib
import json
from pathlib import Path

from hal.config import RobotConfig
from hal.errors import ConfigError
from services.model.model_config import model_config

RUNS = Path("runs")
ROBOTS = Path("robots")


def data_path(robot: str) -> Path:
    """Collected episodes."""
    return RUNS / robot / "data.npz"


def model_folder(robot: str) -> Path:
    """The trained body schema."""
    return RUNS / robot / "model"


def fingerprint(robot: RobotConfig) -> str:
    """Hash of what a model depends on: the signals, and how the robot file wants data collected and it trained."""
    model = model_config(robot)
    content = {
        "signals": {name: list(robot.signals[name].elements) for name in model.signals or robot.signals},
        "conditions": list(robot.conditions),
        "collect": robot.collect,
        "model": [part.model_dump() for part in (model.network, model.structure, model.training)],
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def robot_file(text: str) -> Path:
    """A robot file from its path or from the robot's name (`musashi_arm`).

    Raises:
        ConfigError: There is neither.
    """
    path = Path(text)
    if path.suffix in (".yaml", ".yml") or path.exists():
        return path
    named = ROBOTS / f"{text}.yaml"
    if named.exists():
        return named
    known = ", ".join(sorted(file.stem for file in ROBOTS.glob("*.yaml") if "." not in file.stem)) or "none"
    raise ConfigError(f"There is no robot '{text}'. Known in {ROBOTS}/: {known}; or give the path of a robot file.")
