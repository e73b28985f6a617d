"""The demo of a robot with tools and a camera, interrupted while the robot moves."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from gemuco.checkpoint import save
from gemuco.dataset import Dataset, Episode
from gemuco.learning.train import TrainConfig, fit
from hal.config import load_robot
from hal.errors import ConfigError
from services.demo import demo
from services.model.artifacts import fingerprint
from services.model.living_model import layout_of
from services.process.supervisor import gemuco_command

SERVICES_TESTS = Path(__file__).parents[1] / "services"
sys.path.append(str(SERVICES_TESTS))
from small_hand import TOOLS, config, description, gravity_of, tip_of  # noqa: E402

LOW, HIGH = [-1.0, -2.2], [1.0, 2.2]
"""Of the joints [rad]: so far that the long tool comes to where the short one is."""
PATIENCE = 60.0
"""Longer than anything takes, on a machine with other work [s]."""


def robot_with_model(folder: Path) -> Path:
    """A robot file, beside the model that the demo looks for."""
    name = f"tools_{os.getpid()}"
    file = folder / f"{name}.yaml"
    content = description(name)
    content["model"] |= {"network": {"bias": 2}, "control": {"target": "tool_tip_position", "route": "input"}}
    content["limits"]["joint_position"] |= {"low": LOW, "high": HIGH}
    file.write_text(yaml.safe_dump(content))
    robot = load_robot(file)
    random = np.random.default_rng(0)
    episodes = []
    for condition, tool in TOOLS.items():
        for _ in range(6):
            position = random.uniform(LOW, HIGH, (100, 2))
            tip, gravity = tip_of(position, tool), gravity_of(position, tool)
            whole = {"joint_position": position, "center_of_gravity": gravity, "tool_tip_position": tip}
            episodes.append(Episode(condition, whole))
    dataset = Dataset(layout_of(robot), tuple(episodes))
    training = TrainConfig(hidden=(30, 20), latent=6, bias_size=2, epochs=10, batch=100, rate=1e-2)
    schema, _ = fit(dataset, training, (("joint_position",),), x_out=("center_of_gravity", "tool_tip_position"))
    save(schema.with_manifest(fingerprint=fingerprint(robot)), folder / "runs" / name / "model")
    return file


@pytest.mark.slow
def test_an_interrupted_demo_of_tools_leaves_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(SERVICES_TESTS))
    file, log = robot_with_model(tmp_path), tmp_path / "demo.log"
    deadline = time.monotonic() + PATIENCE
    with log.open("w") as sink:
        played = subprocess.Popen(
            gemuco_command("demo", str(file)), cwd=tmp_path, stdout=sink, stderr=sink, start_new_session=True
        )
    try:
        while "(a)" not in log.read_text():
            assert played.poll() is None, log.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        report = log.read_text()
        report = report[report.rindex("Processes:") : report.index("(a)")]  # the last ones, if a lower rate was needed
        words = report.partition("remote client:")[0].partition("This machine")[0].replace(",", " ").split()
        names = {word for word in words if word.isalpha()}
        assert names == {"simulator", "hal", "vision", "model", "recorder", "client"}
        played.send_signal(signal.SIGINT)
        assert played.wait(PATIENCE) != 0
        pids = [int(word) for word in words if word.isdigit()]
        while any(Path(f"/proc/{pid}").exists() for pid in pids):
            assert time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        played.kill()
        played.wait()


def test_a_robot_without_a_story_is_told_so_before_anything_starts(tmp_path: Path) -> None:
    control = {"control": {"target": "tool_tip_position"}}
    for changes, sentence in (({}, "no model.control section"), ({"model": control, "conditions": []}, "no story for")):
        with pytest.raises(ConfigError, match=sentence):
            demo.play(config("untold", **changes), tmp_path / "untold.yaml", 1, tmp_path)
    assert not list(tmp_path.iterdir())
