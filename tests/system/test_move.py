"""A robot that has no model is moved by one command line, and every answer says what happens."""

import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from arm_stack import PATIENCE, ROOT, eventually

from services.client import Client
from services.process.supervisor import Supervisor, gemuco_command

ELBOW = """
signals: {joint_position: {unit: rad, elements: [elbow]}}
command: {signal: joint_position, hold: 0.5}
limits: {joint_position: {low: -1.5, high: 1.5, rate: 2.0}}
rates: {hal: 100}
kinds: {drive: {driver: cia402, settings: {counts_per_turn: 4096, gear: 50}}}
devices: {elbow_drive: {kind: drive, bus: can0, node: 5, element: joint_position.elbow}}
simulator: simulators.robots.bench:simulator
"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder, name = tmp_path_factory.mktemp("elbow"), f"elbow_{os.getpid()}"
    body = yaml.safe_load(ELBOW) | {"robot": name, "buses": {"can0": {"interface": "hub", "channel": f"{name}_can0"}}}
    body["kinds"]["drive"]["settings"]["eds"] = str(ROOT / "robots" / "eds" / "servo_drive.eds")
    file: Path = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(body))
    with Supervisor(folder / "logs") as supervisor, Client(name) as client:
        for service, verb in (("simulator", "simulate"), ("hal", "hal")):
            supervisor.start(service, gemuco_command(verb, str(file)))

            def runs(service: str = service) -> bool:
                status = client.status(service)
                return status is not None and status.state == "running"

            supervisor.wait_ready(service, runs, PATIENCE)
        yield name


def ask(robot: str, *words: str) -> subprocess.CompletedProcess[str]:
    command = gemuco_command("query", robot, *words)
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)


@pytest.mark.slow
def test_moves_follow_each_other_at_any_time(robot: str) -> None:
    """The drives hold for 0.5 s after a move and then stop; the next one may begin at any moment of this."""
    for index in range(6):
        moved = ask(robot, "move", "joint_position", str(0.1 * (-1) ** index))
        assert moved.returncode == 0, moved.stderr
        time.sleep(0.15 * index)


@pytest.mark.slow
def test_the_commanded_signal_moves_without_a_model(robot: str) -> None:
    for goal in ("0.4", "-0.25"):
        moved = ask(robot, "move", "joint_position", goal)
        assert moved.returncode == 0, moved.stderr
        first, last = moved.stdout.splitlines()
        assert first.startswith("joint_position is at elbow ")
        assert float(first.split()[4]) == pytest.approx(float(goal), abs=0.01)  # rad
        assert last == "The lease has ended: the drives hold for 0.5 s at most and stop as the robot file says."
        assert ask(robot, "holder").stdout == "No client commands this robot.\n"
        with Client(robot) as client:
            eventually(lambda client=client: (now := client.applied(timeout=0.5)) is not None and now.mode == "off")


@pytest.mark.long
def test_what_cannot_move_is_refused_before_the_drives_are_enabled(robot: str) -> None:
    for words, completed in (
        (("joint_position", "2"), "joint_position.elbow of 2 rad is outside of its limits, -1.5 to 1.5."),
        (("joint_position", "0", "0"), "'joint_position' has 1 elements: elbow."),
        (
            ("joint_effort", "0"),
            f"'joint_effort' cannot be moved; joint_position can. With a model, `gemuco serve {robot}`",
        ),
        (("joint_position",), "'move' needs a signal and one value per element"),
        (("joint_position", "up"), "'move' takes numbers after the signal, not 'up'."),
    ):
        answer = ask(robot, "move", *words)
        assert answer.returncode == 1
        assert completed in answer.stderr
    with Client(robot) as client:
        now = client.applied(timeout=2.0)
        assert now is not None
        assert now.mode == "off"


@pytest.mark.long
def test_another_client_that_commands_is_named(robot: str) -> None:
    with Client(robot, name="anna") as anna, anna.lease():
        answer = ask(robot, "move", "joint_position", "0.1")
        assert answer.returncode == 1
        assert "anna commands this robot for another" in answer.stderr


@pytest.mark.slow
def test_enabled_drives_without_commands_are_said_to_switch_off(robot: str) -> None:
    completed = ask(robot, "enable")
    assert completed.stdout.startswith("The drives are enabled and hold their position. They switch off after 0.5 s,")
    assert ask(robot, "disable").stdout.startswith("The drives switch off. The mode is '")
