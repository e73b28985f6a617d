"""Whole robots behind their CAN nodes, read and moved by the HAL on virtual buses; their tools changed meanwhile."""

import time
import uuid
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from hal.robot import open_robot
from simulators.robots import kxr_humanoid, pr2_duster
from simulators.robots.kxr_humanoid.body import REST as STANDING
from simulators.robots.pr2_duster.body import REST as HELD

ROBOTS = Path(__file__).parents[2] / "robots"
PATIENCE = 20.0
"""Longer than anything takes, on a machine with other work [s]."""


@pytest.fixture
def robot_and_rig(request):
    name, simulator, tool = request.param
    config = load_robot(ROBOTS / f"{name}.yaml")
    virtual = {"interface": "virtual", "channel": f"{name}_{uuid.uuid4().hex[:12]}"}
    config = config.model_copy(update={"buses": {"can0": config.buses["can0"].model_copy(update=virtual)}})
    rig = simulator.rig(config, "nominal", 0, tool)
    rig.start()
    with open_robot(config) as robot:
        yield robot, rig
    rig.stop()


humanoid = pytest.mark.parametrize(
    "robot_and_rig", [("kxr_humanoid", kxr_humanoid.simulator, "long_heavy")], ids=["kxr"], indirect=True
)
arm = pytest.mark.parametrize(
    "robot_and_rig", [("pr2_duster", pr2_duster.simulator, "l500_phi30")], ids=["pr2"], indirect=True
)


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


def all_valid(sample):
    return all(valid.all() for valid in sample.valid.values())


def arrived(command):
    return lambda sample: np.abs(sample.values["joint_position"] - command).max() < 1e-3


@humanoid
def test_forces_joints_and_what_is_computed_from_them_arrive(robot_and_rig):
    robot, rig = robot_and_rig
    sample = cycles(robot, all_valid)
    truth = rig.truth()
    assert set(sample.values) == {"joint_position", "foot_force", "center_of_gravity"}
    assert sample.values["joint_position"] == pytest.approx(STANDING, abs=1e-4)
    assert sample.values["foot_force"] == pytest.approx(truth["foot_force"], abs=0.002)
    assert sample.values["center_of_gravity"] == pytest.approx(truth["center_of_gravity"], abs=2e-5)


@humanoid
def test_it_goes_where_it_is_told_and_leans_as_the_designer_foretells(robot_and_rig):
    robot, rig = robot_and_rig
    cycles(robot, all_valid)
    robot.enable()
    command = STANDING + np.array([-0.2, 0.2, 0.1, -0.05])
    there = cycles(robot, arrived(command), command)
    assert there.values["center_of_gravity"] == pytest.approx(rig.truth()["center_of_gravity"], abs=1e-3)
    rig.fault("tool_changed short_light")
    lighter = cycles(robot, lambda s: s.values["foot_force"].sum() < there.values["foot_force"].sum() - 0.7, command)
    assert lighter.values["center_of_gravity"][0] < there.values["center_of_gravity"][0] - 0.005


@arm
def test_joints_arrive_go_where_they_are_told_and_the_duster_changes(robot_and_rig):
    robot, rig = robot_and_rig
    sample = cycles(robot, all_valid)
    assert set(sample.values) == {"joint_position"}
    assert sample.values["joint_position"] == pytest.approx(HELD, abs=1e-4)
    robot.enable()
    command = HELD + np.array([0.1, -0.1, 0.15, 0.2, -0.1, 0.1, 0.3])
    cycles(robot, arrived(command), command)
    before = rig.truth()["tool_tip_position"]
    assert "l300_phi0" in rig.fault("tool_changed l300_phi0")
    assert np.linalg.norm(rig.truth()["tool_tip_position"] - before) > 0.2
