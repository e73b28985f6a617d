"""Real time, real sockets, threads on both sides: the same robot, and the other side dying and coming back."""

import time

import numpy as np
import pytest
from hal_bench import BenchWorld, description, hardware

from hal.config import RobotConfig
from hal.robot import open_robot
from simulators.rig import Rig

LIMIT = 20.0


def cycle_until(robot, condition):
    """Cycle at the robot's rate until a condition of sample and applied holds."""
    deadline = time.monotonic() + LIMIT
    due = time.monotonic()
    while time.monotonic() < deadline:
        sample, applied = robot.cycle()
        if condition(sample, applied):
            return sample, applied
        due = max(due + robot.period, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0.0))
    raise AssertionError(robot.health())


@pytest.fixture
def config(tmp_path):
    body = description("hub")
    for name, bus in body["buses"].items():
        bus["channel"] = str(tmp_path / name)
    return RobotConfig.model_validate(body)


def started(config):
    rig = Rig(config, BenchWorld(), hardware())
    rig.start()
    return rig


def test_runs_and_survives_the_other_side(config):
    rig = started(config)
    robot = open_robot(config)
    try:
        robot.open()
        cycle_until(robot, lambda sample, applied: sample.complete)
        robot.enable()
        sample, _ = cycle_until(robot, lambda sample, applied: applied.mode == "hold")
        goal = sample.values["muscle_length"] + 0.002

        def reached(sample, applied):
            if applied.mode in ("hold", "follow"):
                robot.command(goal, sample.cycle)
            return np.allclose(sample.values["muscle_length"], goal, atol=1e-5)

        cycle_until(robot, reached)
        rig.stop()
        sample, applied = cycle_until(robot, lambda sample, applied: applied.mode == "fault")
        cycle_until(robot, lambda sample, applied: not any(valid.any() for valid in sample.valid.values()))
        assert {bus["state"] for bus in robot.health()["buses"].values()} == {"gone"}
        rig = started(config)
        sample, applied = cycle_until(robot, lambda sample, applied: sample.complete)
        assert applied.mode == "fault"
        robot.reset()
        cycle_until(robot, lambda sample, applied: sample.complete and applied.mode == "off")
    finally:
        robot.close()
        rig.stop()


@pytest.mark.long
def test_starts_before_the_other_side(config):
    robot = open_robot(config)
    try:
        robot.open()
        sample, _ = robot.cycle()
        assert not sample.complete
        rig = started(config)
        cycle_until(robot, lambda sample, applied: sample.complete)
    finally:
        robot.close()
        rig.stop()
