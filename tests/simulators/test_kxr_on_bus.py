"""The humanoid behind its CAN nodes, read and moved by the HAL on a virtual bus."""

import time
import uuid
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from hal.robot import open_robot
from simulators.robots.kxr_humanoid import simulator
from simulators.robots.kxr_humanoid.body import REST

ROBOT = load_robot(Path(__file__).parents[2] / "robots" / "kxr_humanoid.yaml")
PATIENCE = 20.0
"""Longer than anything takes, on a machine with other work [s]."""


@pytest.fixture
def robot_and_rig():
    bus = ROBOT.buses["can0"].model_copy(update={"interface": "virtual", "channel": f"kxr_{uuid.uuid4().hex[:12]}"})
    config = ROBOT.model_copy(update={"buses": {"can0": bus}})
    rig = simulator.rig(config, "nominal", 0, "long_heavy")
    rig.start()
    robot = open_robot(config)
    with robot:
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


def test_forces_joints_and_what_is_computed_from_them_arrive(robot_and_rig):
    robot, rig = robot_and_rig
    sample = cycles(robot, lambda sample: all(valid.all() for valid in sample.valid.values()))
    truth = rig.truth()
    assert set(sample.values) == {"joint_position", "foot_force", "center_of_gravity"}
    assert sample.values["joint_position"] == pytest.approx(REST, abs=1e-4)
    assert sample.values["foot_force"] == pytest.approx(truth["foot_force"], abs=0.002)
    assert sample.values["center_of_gravity"] == pytest.approx(truth["center_of_gravity"], abs=2e-5)


def test_it_goes_where_it_is_told_and_leans_as_the_designer_foretells(robot_and_rig):
    robot, rig = robot_and_rig
    cycles(robot, lambda sample: all(valid.all() for valid in sample.valid.values()))
    robot.enable()
    command = REST + np.array([-0.2, 0.2, 0.1, -0.05])
    arrived = cycles(robot, lambda s: np.abs(s.values["joint_position"] - command).max() < 1e-3, command)
    assert arrived.values["center_of_gravity"] == pytest.approx(rig.truth()["center_of_gravity"], abs=1e-3)
    rig.fault("tool_changed short_light")
    lighter = cycles(robot, lambda s: s.values["foot_force"].sum() < arrived.values["foot_force"].sum() - 0.7, command)
    assert lighter.values["center_of_gravity"][0] < arrived.values["center_of_gravity"][0] - 0.005
