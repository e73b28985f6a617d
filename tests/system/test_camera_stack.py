"""A robot with a camera as processes: simulated nodes, HAL, camera, model. The camera dies, and comes back."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from gemuco.checkpoint import save
from gemuco.dataset import Dataset, Episode
from gemuco.learning.train import TrainConfig, fit
from gemuco.schema import BodySchema
from hal.config import load_robot
from services.client import Client
from services.learning.collector import Request, collect_bus
from services.model.living_model import layout_of
from services.process.supervisor import Supervisor, gemuco_command
from services.wire.messages import Estimates

SERVICES_TESTS = Path(__file__).parents[1] / "services"
sys.path.append(str(SERVICES_TESTS))
from small_hand import OUT_OF_SIGHT, TOOLS, description, gravity_of, tip_of  # noqa: E402

PATIENCE = 30.0
"""Longer than anything takes, on a machine with other work [s]."""
CLOSE = 0.08
"""An estimate of the tool tip is this good [m], or it is none."""


def eventually(condition: Callable[[], bool], timeout: float = PATIENCE) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


def small_model(file: Path) -> BodySchema:
    """Trained in seconds on the designer's geometry, of both tools."""
    random = np.random.default_rng(0)
    episodes = []
    for condition, tool in TOOLS.items():
        position = random.uniform([-0.6, -1.0], [0.9, 1.0], (800, 2))
        tip = tip_of(position, tool)
        kept = tip[:, 1] > OUT_OF_SIGHT
        whole = {
            "joint_position": position[kept],
            "center_of_gravity": gravity_of(position[kept], tool),
            "tool_tip_position": tip[kept],
        }
        for part in np.array_split(np.arange(kept.sum()), 6):
            episodes.append(Episode(condition, {name: rows[part] for name, rows in whole.items()}))
    dataset = Dataset(layout_of(load_robot(file)), tuple(episodes))
    config = TrainConfig(hidden=(30, 20), latent=6, bias_size=2, epochs=15, batch=100, rate=1e-2)
    return fit(dataset, config, (("joint_position",), ("joint_position", "center_of_gravity")))[0]


class Stack:
    """The processes of one robot, started and killed by name."""

    def __init__(self, folder: Path, robot: str) -> None:
        self.robot = robot
        self.file = folder / f"{robot}.yaml"
        self.file.write_text(yaml.safe_dump(description(robot)))
        model = folder / "model"
        save(small_model(self.file).under("short"), model)
        self.supervisor = Supervisor(folder / "logs")
        self.client = Client(robot)
        self.commands = {
            "simulator": ("simulate", str(self.file), "--condition", "short"),
            "hal": ("hal", str(self.file)),
            "vision": ("vision", str(self.file)),
            "model": ("serve", str(self.file), "--model", str(model)),
        }

    def start(self, *names: str) -> None:
        for name in names:
            self.supervisor.start(name, gemuco_command(*self.commands[name]))
            self.supervisor.wait_ready(name, lambda name=name: self.client.status(name) is not None, PATIENCE)

    def estimate(self) -> Estimates:
        found = self.client.estimate(timeout=PATIENCE)
        assert found is not None
        return found

    def method(self, signal: str = "tool_tip_position") -> str:
        found = self.client.estimate()
        return "" if found is None else found.method[signal]

    def true_tip(self) -> np.ndarray:
        found = self.client.truth(timeout=PATIENCE)
        assert found is not None
        return found.values["tool_tip_position"]

    def said(self, service: str) -> str:
        status = self.client.status(service)
        return "" if status is None else status.text


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(SERVICES_TESTS))
        stack = Stack(tmp_path_factory.mktemp("camera"), f"camera_{os.getpid()}")
        with stack.supervisor, stack.client:
            stack.start("simulator", "hal", "vision", "model")
            eventually(lambda: stack.method() == "measured" and stack.method("center_of_gravity") == "measured")
            yield stack


@pytest.mark.long
def test_what_the_camera_sees_and_the_hal_computes_is_measured(stack: Stack) -> None:
    found, truth = stack.estimate(), stack.client.truth(timeout=PATIENCE)
    assert truth is not None
    assert list(found.values) == ["joint_position", "center_of_gravity", "tool_tip_position"]
    assert set(found.method.values()) == {"measured"}
    assert not any(part.any() for part in found.estimated.values())
    np.testing.assert_allclose(found.values["tool_tip_position"], truth.values["tool_tip_position"], atol=1e-3)
    np.testing.assert_allclose(found.values["center_of_gravity"], truth.values["center_of_gravity"], atol=1e-3)
    assert stack.client.describe("simulator")["condition"] == "short"
    assert stack.client.describe("hal")["conditions"] == ["short", "long"]
    hal = stack.client.sample(timeout=PATIENCE)
    assert hal is not None
    assert "tool_tip_position" not in hal.values


@pytest.mark.long
def test_without_its_camera_the_tool_tip_is_estimated_and_marked_until_it_is_back(stack: Stack) -> None:
    stack.supervisor.kill("vision")
    eventually(lambda: stack.method() == "mask")
    found = stack.estimate()
    assert found.estimated["tool_tip_position"].all()
    assert not found.estimated["joint_position"].any()
    assert np.abs(found.values["tool_tip_position"] - stack.true_tip()).max() < CLOSE
    eventually(lambda: "No camera publishes. Is `gemuco vision` running?" in stack.said("model"))
    stack.start("vision")
    eventually(lambda: stack.method() == "measured")
    eventually(lambda: stack.said("model") == "")


@pytest.mark.long
def test_a_covered_camera_is_not_a_dead_one(stack: Stack) -> None:
    stack.client.fault("camera_covered", "vision")
    eventually(lambda: stack.method() == "mask")
    eventually(lambda: stack.said("model") == "Estimating tool_tip_position: not measured at the moment.")
    stack.client.fault("camera_back", "vision")
    eventually(lambda: stack.method() == "measured")


@pytest.mark.long
def test_without_its_hal_the_camera_alone_is_told_for_what_it_is(stack: Stack) -> None:
    stack.supervisor.kill("hal")
    eventually(lambda: stack.estimate().cycle == -1)
    found = stack.estimate()
    assert found.method["tool_tip_position"] == "measured"
    assert found.estimated["joint_position"].all()
    eventually(lambda: "No fresh sample comes from the HAL" in stack.said("model"))
    stack.start("hal")
    eventually(lambda: stack.method("joint_position") == "measured")


@pytest.mark.long
def test_another_tool_moves_what_the_camera_sees(stack: Stack) -> None:
    before = stack.true_tip()
    joints = stack.estimate().values["joint_position"]
    assert tip_of(joints[None], TOOLS["long"])[0, 1] > OUT_OF_SIGHT, "in sight with either tool, as at the start"
    assert stack.client.fault("tool_changed long") == {"text": "The tool is now long."}
    eventually(lambda: float(np.linalg.norm(stack.true_tip() - before)) > 0.1)

    def is_measured() -> bool:
        estimate, truth = stack.estimate(), stack.true_tip()
        is_right = np.abs(estimate.values["tool_tip_position"] - truth).max() < 1e-3
        return bool(is_right) and estimate.method["tool_tip_position"] == "measured"

    eventually(is_measured)
    stack.client.fault("tool_changed short")


@pytest.mark.long
def test_collecting_on_the_bus_records_what_the_camera_sees_under_the_told_condition(stack: Stack) -> None:
    robot = load_robot(stack.file)
    eventually(lambda: stack.method("joint_position") == "measured")
    dataset = collect_bus(robot, 0, Request(("borrowed",), 20)).dataset
    assert dataset.conditions == ("borrowed",)
    assert dataset.rows().shape == (20, 6)
    assert np.isfinite(dataset.rows()).all()
    for episode in dataset.episodes:
        tip = tip_of(episode.values["joint_position"], TOOLS["short"])
        seen = episode.values["tool_tip_position"]
        assert np.abs(seen - tip).max() < 0.25, "a frame is as old as a frame is, while the arm moves at 2 rad/s"
