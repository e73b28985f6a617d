"""Paths of a robot's data and model, and the fingerprint that links a model to a robot file."""

import difflib
import hashlib
import json
from pathlib import Path

from hal.config import RobotConfig
from hal.errors import ConfigError
from services.model.model_config import model_config

RUNS = Path("runs")
ROBOTS = Path("robots")
"""The user's robot files are in this folder of the working directory."""
SHIPPED = Path(__file__).resolve().parents[2] / "robots"
"""Robot files of this package are beside its modules, in a checkout and in an installation."""


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
    """Return the path of a robot file, given its path or the robot's name (`musashi_arm`), the user's own first.

    Raises:
        ConfigError: There is no such file.
    """
    path = Path(text)
    if path.suffix in (".yaml", ".yml") or path.exists():
        return path
    for folder in (ROBOTS, SHIPPED):
        if (named := folder / f"{text}.yaml").exists():
            return named
    files = [file.stem for folder in (ROBOTS, SHIPPED) for file in folder.glob("*.yaml")]
    names = sorted({stem for stem in files if "." not in stem})
    if path.suffix or len(path.parts) > 1:
        raise ConfigError(
            f"There is no file '{text}'. Is its folder right? Robots by name: {', '.join(names) or 'none'}."
        )
    near = difflib.get_close_matches(text, names, 1)
    hint = f"Did you mean '{near[0]}'? " if near else ""
    raise ConfigError(
        f"There is no robot '{text}'. {hint}Known robots: {', '.join(names) or 'none'}; or give the path of a robot "
        "file."
    )
