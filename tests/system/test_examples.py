"""Every example that needs no running robot runs as its docstring says; the others say what they need."""

import itertools
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from services.client import Client
from services.process.service import Service
from services.wire import keys
from services.wire.history import HistoryRing
from services.wire.messages import Estimates, Sample
from services.wire.session import endpoint

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments], capture_output=True, text=True, timeout=100, check=False
    )


def test_lost_sensor_is_estimated() -> None:
    done = run("lost_sensor.py")
    assert done.returncode == 0, done.stderr
    page = (EXAMPLES.parent / "docs" / "lost_sensor.md").read_text().split("```\n")[2]

    def words(text: str) -> set[str]:
        return {re.sub(r"[\d. ]+", " ", line) for line in text.splitlines() if line != "..."}

    assert words(page) <= words(done.stdout)


@pytest.mark.slow
def test_a_tool_that_was_never_held_is_recognised() -> None:
    done = run("another_tool.py")
    assert done.returncode == 0, done.stderr
    before, after = (int(number) for number in re.findall(r"by (\d+) mm", done.stdout))
    assert before > 200
    assert after < 30


@pytest.mark.long
def test_arm_moves_without_a_bus() -> None:
    pytest.importorskip("pybullet", reason="the extra 'sim' is not installed")
    done = run("move_without_bus.py")
    assert done.returncode == 0, done.stderr
    assert "mode follow" in done.stdout


NAMES = {"joint_position": ("rad", ["shoulder", "elbow"]), "joint_load": ("N", ["shoulder", "elbow"])}


class SmallRobot:
    """A HAL and a model service that tell what examples ask for, with numbers that are made up."""

    def __init__(self, robot: str) -> None:
        signals = {name: {"unit": unit, "elements": elements} for name, (unit, elements) in NAMES.items()}
        self._hal = Service(robot, "hal", describe=lambda: {"signals": signals})
        self._model = Service(robot, "model", describe=lambda: {"signals": signals})
        self._robot = robot
        self._ring = HistoryRing({name: len(elements) for name, (_, elements) in NAMES.items()}, 100.0)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._publish)

    def __enter__(self) -> Self:
        self._hal.__enter__()
        self._model.__enter__()
        boot = self._model.boot
        self._model.verb("history", lambda asked: self._ring.answer(asked, boot, time.monotonic()))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()
        self._model.__exit__(None, None, None)
        self._hal.__exit__(None, None, None)

    def _publish(self) -> None:
        samples = self._hal.publisher(keys.sample(self._robot), Sample)
        estimates = self._model.publisher(keys.estimate(self._robot), Estimates)
        for cycle in itertools.count():
            if self._done.wait(0.01):
                return
            values = {name: np.array([np.sin(0.1 * cycle), 2.0]) for name in NAMES}
            first, none = np.array([True, False]), np.zeros(2)
            samples.put(
                Sample(
                    cycle=cycle, source="simulated", complete=True, values=values,
                    age=dict.fromkeys(NAMES, none), valid=dict.fromkeys(NAMES, first),
                )
            )  # fmt: skip
            found = Estimates(
                stamp_ns=time.time_ns(), cycle=cycle, values=values, estimated=dict.fromkeys(NAMES, first),
                std=dict.fromkeys(NAMES, none), method=dict.fromkeys(NAMES, "mask"),
                mask=dict.fromkeys(NAMES, "joint_load"), residual=dict.fromkeys(NAMES, 0.0),
            )  # fmt: skip
            estimates.put(found)
            self._ring.add(found, time.monotonic())


@pytest.mark.long
def test_estimates_are_watched_and_plotted_and_samples_read_from_the_wire(tmp_path: Path) -> None:
    robot = f"examples_{os.getpid()}"
    with SmallRobot(robot):
        watching = subprocess.Popen(
            [sys.executable, str(EXAMPLES / "watch_estimates.py"), robot], stdout=subprocess.PIPE, text=True
        )
        assert watching.stdout is not None
        lines = [watching.stdout.readline() for _ in range(4)]
        watching.kill()
        watching.communicate()
        assert [line.split()[0] for line in lines] == [*NAMES, *NAMES]
        assert "mask joint_load" in lines[0]

        picture = tmp_path / "estimates.png"
        done = run("plot_estimates.py", robot, "--seconds", "5", "--live", "0.3", "--out", str(picture))
        assert done.returncode == 0, done.stderr
        assert re.search(r"\d+ estimates of the past and \d+ live ones", done.stdout)
        assert picture.read_bytes().startswith(b"\x89PNG")

        for given in ((), (endpoint(robot, "hal"),)):
            done = run("read_wire.py", robot, *given)
            assert done.returncode == 0, done.stderr
            assert "joint_load" in done.stdout
            assert "[ True False]" in done.stdout


def test_a_marker_is_published() -> None:
    robot = f"marker_{os.getpid()}"
    with Client(robot) as client:
        publishing = subprocess.Popen([sys.executable, str(EXAMPLES / "publish_marker.py"), robot, "30"])
        try:
            sample = next(iter(client.sensors("vision", deadline=25.0)))
        finally:
            publishing.kill()
            publishing.communicate()
    assert sample.values["tool_tip_position"].tolist() == [0.6, -0.2, 0.8]


@pytest.mark.long
@pytest.mark.parametrize("example", ["watch_estimates.py", "plot_estimates.py"])
def test_watching_nobody_is_one_sentence(example: str) -> None:
    done = run(example, "nobody_at_all")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "nobody_at_all" in done.stderr
