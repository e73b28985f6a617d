"""The PR2's arm behind its CAN nodes, read and moved by the HAL on a virtual bus; its duster changed meanwhile."""

import time
import uuid
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from hal.robot import open_robot
from simulators.robots.pr2_duster import simulator
from simulators.robots.pr2_duster.body import REST

ROBOT = load_robot(Path(__file__).parents[2] / "robots" / "pr2_duster.yaml")
PATIENCE = 20.0
"""Longer than anything takes, on a machine with other work [s]."""


@pytest.fixture
def robot_and_rig():
    bus = ROBOT.buses["can0"].model_copy(update={"interface": "virtual", "channel": f"pr2_{uuid.uuid4().hex[:12]}"})
    config = ROBOT.model_copy(update={"buses": {"can0": bus}})
    rig = simulator.rig(config, "nominal", 0, "l500_phi30")
    rig.start()
    with open_robot(config) as robot:
        yield robot, rig
    rig.stop()


def cycles(robot, goal, command=None):
    """Cycle in real time until the newest sample is as wanted; that sample."""
    deadline = time.monotonic() + PATIENCE
    due = robot.clock.monotonic()
    while time.monotonic() < deadline:
        sample, _ = robot.cycle()
        if goal(sample):
            return sample
        if command is not None and robot.mode in ("hold", "follow"):
            robot.command(command, sample.cycle)
        due = max(due + robot.period, robot.clock.monotonic())
        robot.clock.sleep_until(due)
    raise AssertionError(f"It did not come: mode {robot.mode}, {sample.values}.")


def test_joints_arrive_go_where_they_are_told_and_the_duster_changes(robot_and_rig):
    robot, rig = robot_and_rig
    sample = cycles(robot, lambda sample: all(valid.all() for valid in sample.valid.values()))
    assert set(sample.values) == {"joint_position"}
    assert sample.values["joint_position"] == pytest.approx(REST, abs=1e-4)
    robot.enable()
    command = REST + np.array([0.1, -0.1, 0.15, 0.2, -0.1, 0.1, 0.3])
    cycles(robot, lambda s: np.abs(s.values["joint_position"] - command).max() < 1e-3, command)
    before = rig.truth()["tool_tip_position"]
    assert "l300_phi0" in rig.fault("tool_changed l300_phi0")
    assert np.linalg.norm(rig.truth()["tool_tip_position"] - before) > 0.2
