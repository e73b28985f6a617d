"""The HAL as a process that is stopped, frozen, killed or told to end while the robot moves."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from small_arm import FRESH, Processes, eventually

from hal.errors import CommandRefused
from services.client import Client
from services.wire import keys
from services.wire.messages import Status

ROOT = Path(__file__).resolve().parents[2]
RATE = 0.25
"""Of the small arm's limits [m/s]."""
SLACK = 0.01
"""What is moved [m] while a message travels."""


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    with Processes(f"stopped_arm_{os.getpid()}", tmp_path_factory.mktemp("robot")) as processes:
        yield processes


class Mover:
    """Commands ever longer wires from a thread, as a client does that does not look where it goes."""

    def __init__(self, arm: Processes) -> None:
        self._arm = arm
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "Mover":
        _enable(self._arm)
        self._thread.start()
        eventually(lambda: self._arm.mode() == "follow")
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        with Client(self._arm.robot) as client:
            while not self._done.is_set():
                sample = client.next_sample(0.1)
                if sample is not None:
                    client.command("muscle_length", sample.values["muscle_length"] + 0.1, sample)


def _enable(arm: Processes) -> None:
    def holds() -> bool:
        try:
            if arm.mode() in ("off", "fault"):
                arm.client.reset()  # a drive may be in fault though the robot is not
                arm.client.enable()
        except CommandRefused:
            return False
        return arm.mode() in ("hold", "follow")

    eventually(lambda: arm.all_valid())
    eventually(holds)


def _length(arm: Processes) -> np.ndarray:
    """Where the wires really are [m], shape (2,)."""
    truth = arm.client.truth(max_age=FRESH, timeout=5.0)
    assert truth is not None
    return truth.values["muscle_length"]


def _rests(arm: Processes) -> bool:
    before = _length(arm)
    time.sleep(0.1)
    return bool((_length(arm) == before).all())


def _gemuco(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT, check=False)


@pytest.mark.long
def test_an_estop_answers_per_drive_and_is_latched(arm: Processes) -> None:
    with Mover(arm):
        answer = arm.client.estop("a test")
        assert answer["complete"] is True
        assert [one["device"] for one in answer["devices"]] == ["biceps_drive", "triceps_drive"]
        assert all("stopped and without power after" in one["text"] for one in answer["devices"])
        assert _rests(arm)
        eventually(lambda: arm.mode() == "fault")
        with pytest.raises(CommandRefused, match="Emergency stop: a test"):
            arm.client.enable()


@pytest.mark.long
def test_gemuco_estop_says_what_every_drive_did(arm: Processes) -> None:
    with Mover(arm):
        said = _gemuco("estop", arm.robot)
    assert said.returncode == 0, said.stderr
    assert "biceps_drive: stopped and without power after " in said.stdout
    assert "All 2 drives stopped." in said.stdout


@pytest.mark.long
def test_gemuco_estop_is_loud_when_a_drive_does_not_answer(arm: Processes) -> None:
    arm.client.fault("node_silent triceps_drive")
    said = _gemuco("estop", arm.robot)
    arm.client.fault("node_back triceps_drive")
    assert said.returncode == 1
    assert "biceps_drive: stopped" in said.stdout
    assert "triceps_drive: did not answer (silent); cut the power" in said.stderr
    assert "*** NOT STOPPED: triceps_drive. CUT THE POWER. ***" in said.stderr


def test_gemuco_estop_is_loud_when_nobody_is_there() -> None:
    said = _gemuco("estop", "nobody_here")
    assert said.returncode == 1
    assert "CUT THE POWER" in said.stderr
    assert "Is `gemuco hal` running?" in said.stderr
    assert "Traceback" not in said.stderr


@pytest.mark.long
@pytest.mark.parametrize("frozen", [0.3, 3.0])
def test_a_hal_that_was_frozen_moves_nothing_when_it_goes_on(arm: Processes, frozen: float) -> None:
    with Mover(arm):
        os.kill(arm.pid("hal"), signal.SIGSTOP)
        try:
            eventually(lambda: _rests(arm))
            where = _length(arm)
            time.sleep(frozen)
        finally:
            os.kill(arm.pid("hal"), signal.SIGCONT)
        eventually(lambda: arm.mode() == "fault")
        time.sleep(0.2)
        np.testing.assert_allclose(_length(arm), where, atol=1e-6)
    status = arm.client.reader(keys.status(arm.robot, "hal"), Status).wait(5.0)
    assert status is not None
    assert "did not turn for" in status.text


@pytest.mark.long
def test_the_drives_of_a_killed_hal_stop_by_themselves(arm: Processes) -> None:
    with Mover(arm):
        before = _length(arm)
        arm.kill("hal")
        eventually(lambda: _rests(arm))
        assert (np.abs(_length(arm) - before) < RATE * 0.5 + SLACK).all()
    arm.start("hal")
    eventually(lambda: arm.mode() == "off")


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_hal_that_is_told_to_end_while_it_moves_stops_first(arm: Processes, number: signal.Signals) -> None:
    with Mover(arm):
        os.kill(arm.pid("hal"), number)
        code, said = arm.ended("hal")
        assert code == 0
        assert "Traceback" not in said
        assert _rests(arm)
    arm.start("hal")
    _enable(arm)
    arm.client.disable()
    eventually(lambda: arm.mode() == "off")
