"""The whole stack as processes: simulated nodes, HAL and model of the shipped arm under a name of its own."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from hal.config import load_robot
from hal.errors import CommandRefused
from services.artifacts import fingerprint
from services.client import Client
from services.errors import NotEngaged, TargetRefused
from services.supervisor import Supervisor, gemuco_command

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tests" / "services"))
from arm_model import small_model  # noqa: E402

PATIENCE = 30.0
"""Longer than anything takes, on a machine with other work [s]."""


def eventually(condition: Callable[[], bool], timeout: float = PATIENCE) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


class Stack:
    """The processes of one robot, started and killed by name."""

    def __init__(self, folder: Path, robot: str) -> None:
        self.folder, self.robot = folder, robot
        description = yaml.safe_load((ROOT / "robots" / "musashi_arm.yaml").read_text())
        description["robot"] = robot
        for bus in description["buses"]:
            description["buses"][bus]["channel"] = f"{robot}_{bus}"
        for kind in description["kinds"].values():
            kind["settings"]["eds"] = str(ROOT / "robots" / kind["settings"]["eds"])
        self.file = folder / f"{robot}.yaml"
        self.file.write_text(yaml.safe_dump(description, sort_keys=False))
        self.model = folder / "runs" / robot / "model"
        small_model().with_manifest(fingerprint=fingerprint(load_robot(self.file))).save(self.model)
        self.supervisor = Supervisor(folder / "logs")
        self.client = Client(robot)
        self.commands = {
            "simulator": ("simulate", str(self.file)),
            "hal": ("hal", str(self.file)),
            "model": ("serve", str(self.file), "--model", str(self.model)),
        }

    def start(self, *names: str) -> None:
        for name in names:
            self.supervisor.start(name, gemuco_command(*self.commands[name]))
            self.supervisor.wait_ready(name, lambda name=name: self.state(name) == "running", PATIENCE)

    def state(self, service: str) -> str:
        status = self.client.status(service)
        return "" if status is None else status.state

    def method(self) -> str:
        estimate = self.client.estimate()
        return "" if estimate is None else estimate.method["joint_position"]

    def mode(self) -> str:
        applied = self.client.applied(timeout=0.5)
        return "" if applied is None else applied.mode

    def engage(self) -> None:
        def follows() -> bool:
            if self.mode() == "fault":
                self.client.reset()
            try:
                if self.mode() not in ("hold", "follow"):
                    self.client.engage()
            except (NotEngaged, CommandRefused):
                return False  # a moment without a fresh sample, or a drive that is not ready yet
            return self.mode() == "follow"

        eventually(follows)


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    stack = Stack(tmp_path_factory.mktemp("stack"), f"stack_{os.getpid()}")
    with stack.supervisor, stack.client:
        stack.start("simulator", "hal", "model")
        yield stack


def ask(stack: Stack, *words: str) -> subprocess.CompletedProcess[str]:
    command = gemuco_command("query", stack.robot, *words)
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, cwd=stack.folder, check=False)


def test_measurements_flow_from_the_wire_to_the_estimate(stack: Stack) -> None:
    eventually(lambda: stack.method() == "measured")
    estimate, truth = stack.client.estimate(timeout=2.0), stack.client.truth(timeout=2.0)
    assert estimate is not None
    assert truth is not None
    np.testing.assert_allclose(estimate.values["joint_position"], truth.values["joint_position"], atol=0.02)  # rad
    assert estimate.cycle > 0


def test_a_silent_encoder_is_estimated_by_another_process_too(stack: Stack) -> None:
    stack.client.fault("sensor_silent elbow_pitch_encoder")
    eventually(lambda: stack.method() == "mask")
    answer = ask(stack, "estimate", "joint_position")
    assert answer.returncode == 0, answer.stderr
    estimate, truth = stack.client.estimate(timeout=2.0), stack.client.truth(timeout=2.0)
    assert estimate is not None
    assert truth is not None
    assert estimate.estimated["joint_position"][3]
    error = estimate.values["joint_position"] - truth.values["joint_position"]
    assert np.abs(error).max() < 0.3  # rad
    stack.client.fault("node_back elbow_pitch_encoder")
    eventually(lambda: stack.method() == "measured")


def test_what_cannot_be_is_refused_in_one_sentence(stack: Stack) -> None:
    with pytest.raises(TargetRefused, match=r"elbow_pitch of 9\.000 rad is outside of its limits"):
        stack.client.ask("model", "target", {"signal": "joint_position", "values": [0, 0, 0, 9, 0]})
    for words, sentence in (
        (("estimate", "elbow"), "Signal 'elbow' is not in the schema. Known signals: joint_position"),
        (("dance",), "'dance' is not something to ask. Known: estimate, "),
        (("fault", "coffee"), "'coffee' is no part that can break"),
    ):
        answer = ask(stack, *words)
        assert answer.returncode == 1
        assert sentence in answer.stderr
        assert "Traceback" not in answer.stderr
    assert stack.mode() == "off"


def test_the_model_can_be_asked_what_it_is_and_does(stack: Stack) -> None:
    described = ask(stack, "describe", "model")
    assert "muscle_tension+muscle_length" in described.stdout
    assert "active: true" in ask(stack, "adapt", "on").stdout
    assert "active: false" in ask(stack, "rollback").stdout
    normal = ask(stack, "normal")
    assert normal.returncode == 1
    assert "Let the robot move for a while with the update stopped." in normal.stderr
    values = {"muscle_tension": [50.0] * 10, "muscle_length": [0.2] * 10}
    answer = stack.client.infer("joint_position", values)
    assert answer["method"] == "mask"
    assert answer["cycle"] == -1
    top = subprocess.run(
        gemuco_command("top", stack.robot, "--once"), capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert top.returncode == 0
    for word in ("simulator", "estimation", "joint_position", "motors: off", "anomaly"):
        assert word in top.stdout


def test_a_second_model_service_is_refused(stack: Stack) -> None:
    command = gemuco_command("serve", str(stack.file), "--model", str(stack.model))
    second = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert second.returncode == 1
    assert "already" in second.stderr
    assert "Traceback" not in second.stderr


def test_the_arm_follows_and_stops_when_the_model_is_killed(stack: Stack) -> None:
    stack.engage()
    pose = [-0.3, -0.2, 0.1, -0.9, 0.1]
    stack.client.ask("model", "target", {"signal": "joint_position", "values": pose})

    def is_there() -> bool:
        truth = stack.client.truth()
        return truth is not None and float(np.abs(truth.values["joint_position"] - pose).max()) < 0.4  # rad

    eventually(is_there)
    stack.supervisor.kill("model")
    eventually(lambda: stack.mode() in ("hold", "stopping", "off"))
    eventually(lambda: stack.mode() == "off")
    assert stack.client.sample(timeout=2.0) is not None
    stack.start("model")
    eventually(lambda: stack.method() == "measured")
    assert stack.mode() == "off"


@pytest.mark.parametrize("name", ["hal", "simulator"])
def test_a_killed_process_comes_back_and_state_flows_again(stack: Stack, name: str) -> None:
    stack.supervisor.kill(name)
    eventually(lambda: stack.method() in ("none", ""))
    stack.start(name)
    eventually(lambda: stack.method() == "measured")
    assert stack.mode() == "off"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demo_leaves_no_process(tmp_path: Path, number: signal.Signals) -> None:
    stack = Stack(tmp_path, f"demo_{number.name.lower()}_{os.getpid()}")
    log = tmp_path / "demo.log"
    with log.open("w") as sink:
        demo = subprocess.Popen(
            gemuco_command("demo", str(stack.file)), cwd=tmp_path, stdout=sink, stderr=sink, start_new_session=True
        )
    try:
        eventually(lambda: "Processes:" in log.read_text() or demo.poll() is not None)
        line = next((line for line in log.read_text().splitlines() if line.startswith("Processes:")), None)
        assert line is not None, log.read_text()
        pids = [int(word.strip(",")) for word in line.split() if word.strip(",").isdigit()]
        assert len(pids) >= 3
        demo.send_signal(number)
        assert demo.wait(PATIENCE) != 0
        eventually(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    finally:
        demo.kill()
        demo.wait()
