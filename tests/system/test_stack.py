"""The whole stack as processes: simulated nodes, HAL and model of the shipped arm under a name of its own."""

import os
import re
import subprocess
from collections.abc import Iterator

import numpy as np
import pytest
from arm_stack import PATIENCE, ROOT, Stack, eventually

from services.errors import TargetRefused
from services.process.supervisor import gemuco_command


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


@pytest.mark.long
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


@pytest.mark.long
def test_what_cannot_be_is_refused_in_one_sentence(stack: Stack) -> None:
    with pytest.raises(TargetRefused, match=r"elbow_pitch of 9\.000 rad is outside of its limits"):
        stack.client.ask("model", "target", {"signal": "joint_position", "values": [0, 0, 0, 9, 0]})
    for words, sentence in (
        (("estimate", "elbow"), "Signal 'elbow' is not in the schema. Known signals: joint_position"),
        (("dance",), "'dance' is not a verb of query. Known: estimate, "),
        (("fault", "coffee"), "'coffee' is not a part that can break"),
    ):
        answer = ask(stack, *words)
        assert answer.returncode == 1
        assert sentence in answer.stderr
        assert "Traceback" not in answer.stderr
    assert stack.mode() == "off"


@pytest.mark.slow
def test_the_model_can_be_asked_what_it_is_and_does(stack: Stack) -> None:
    described = ask(stack, "describe", "model")
    assert "muscle_tension+muscle_length" in described.stdout
    assert "The online update runs and learns" in ask(stack, "adapt", "on").stdout
    assert "The model before the online update is in use again" in ask(stack, "rollback").stdout
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


@pytest.mark.long
def test_a_second_model_service_is_refused(stack: Stack) -> None:
    command = gemuco_command("serve", str(stack.file), "--model", str(stack.model))
    second = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert second.returncode == 1
    assert "already" in second.stderr
    assert "Traceback" not in second.stderr


@pytest.mark.long
def test_the_remote_client_of_the_front_page_moves_the_arm(stack: Stack) -> None:
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    program = snippets[1].replace('"musashi_arm"', repr(stack.robot), 1) + "            break\n"
    eventually(lambda: stack.method() == "measured")
    names: dict[str, object] = {}
    exec(program, names)
    assert names["now"].values["joint_position"].shape == (5,)
    eventually(lambda: stack.mode() == "off")


@pytest.mark.long
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
@pytest.mark.long
def test_a_killed_process_comes_back_and_state_flows_again(stack: Stack, name: str) -> None:
    stack.supervisor.kill(name)
    eventually(lambda: stack.method() in ("none", ""))
    stack.start(name)
    eventually(lambda: stack.method() == "measured")
    assert stack.mode() == "off"


@pytest.mark.long
def test_a_client_gets_the_lease_after_somebody_engaged_by_a_query(stack: Stack) -> None:
    eventually(stack.is_measured)
    engaged = ask(stack, "engage")
    assert "The controller is engaged and holds joint_position." in engaged.stdout, engaged.stderr
    eventually(lambda: stack.mode() == "follow")
    with stack.client.lease():  # as in the README, by another program
        stack.client.engage()
        eventually(lambda: stack.mode() == "follow")
        assert stack.client.holder().name.startswith(stack.client._link.caller.name)
    eventually(lambda: stack.mode() in ("off", "stopping"))
    idle = ask(stack, "target", "joint_position", "0.1", "0.1", "0", "-0.6", "0")
    assert idle.stdout.startswith("Nothing moves: the controller is not engaged.")


@pytest.mark.slow
def test_a_target_is_reached_by_one_command_line(stack: Stack) -> None:
    eventually(lambda: stack.mode() == "off")
    answer = ask(stack, "move", "joint_position", "0.2", "-0.3", "0.0", "-0.9", "0.1")
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.startswith("joint_position is at shoulder_roll ")
    assert "The lease has ended" in answer.stdout
    assert "No client commands this robot." in ask(stack, "holder").stdout
    wrong = ask(stack, "move", "muscle_tension", "1")
    assert "'muscle_tension' cannot be moved; muscle_length or joint_position can." in wrong.stderr
