"""The shipped robot files against the simulated hardware, which shares no numbers with them."""

from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from simulators.nodes.canopen.spec import CellConstants, DriveConstants
from simulators.robots import kxr_humanoid, musashi_arm, pr2_duster
from simulators.robots.kxr_humanoid import body as kxr_body
from simulators.robots.pr2_duster import body as pr2_body

MODULES = {"musashi_arm": musashi_arm, "pr2_duster": pr2_duster, "kxr_humanoid": kxr_humanoid}
ROBOTS = {name: load_robot(Path(__file__).parents[2] / "robots" / f"{name}.yaml") for name in MODULES}
NODES = {name: {node.name: node for node in module.hardware()} for name, module in MODULES.items()}
CALIBRATED = ("counts_per_turn", "gear", "spool_radius", "rated_torque")
"""Of drives and encoders; a robot file says as much of it as its drivers need."""


@pytest.mark.parametrize("robot", MODULES)
def test_every_device_hangs_where_the_robot_file_says(robot):
    config, nodes = ROBOTS[robot], NODES[robot]
    assert set(nodes) == set(config.devices)
    for name, device in config.devices.items():
        node = nodes[name]
        assert (node.bus, node.node, node.element) == (device.bus, device.node, device.element)
        assert config.settings_of(name)["eds"] == f"eds/{node.kind}.eds"


@pytest.mark.parametrize(("robot", "name"), [(robot, name) for robot, nodes in NODES.items() for name in nodes])
def test_the_robot_files_calibration_is_the_hardwares(robot, name):
    constants, settings = NODES[robot][name].constants, ROBOTS[robot].settings_of(name)
    if isinstance(constants, CellConstants):
        assert settings.get("zero", 0.0) == -constants.unbalance
        return
    for key in CALIBRATED:
        if key in settings:
            assert settings[key] == getattr(constants, key)
    assert settings["counts_per_turn"] == constants.counts_per_turn
    if isinstance(constants, DriveConstants):
        assert settings["gear"] == constants.gear
        assert settings.get("spool_radius") == constants.spool_radius
    assert settings.get("direction", 1) == constants.direction
    assert settings.get("zero", 0.0) == pytest.approx(constants.zero, abs=1e-6)


@pytest.mark.parametrize("robot", MODULES)
def test_the_simulator_knows_every_condition_of_the_robot_file(robot):
    assert set(ROBOTS[robot].conditions) <= set(MODULES[robot].simulator.conditions)


def test_a_muscles_drive_and_cell_share_a_bus():
    nodes = NODES["musashi_arm"]
    for element in ROBOTS["musashi_arm"].signals["muscle_length"].elements:
        assert nodes[f"{element}_drive"].bus == nodes[f"{element}_cell"].bus


def test_the_musashi_arms_drives_were_zeroed_at_about_the_rest_posture():
    world = musashi_arm.simulator.world("geometric", 0)
    elements = ROBOTS["musashi_arm"].signals["muscle_length"].elements
    rest = dict(zip(elements, world.truth()["muscle_length"], strict=True))
    world.close()
    for name, node in NODES["musashi_arm"].items():
        if isinstance(node.constants, DriveConstants):
            assert node.constants.zero == pytest.approx(rest[name.removesuffix("_drive")], abs=0.005)


def test_the_musashi_arms_drives_are_strong_enough_for_the_tension_at_which_the_spool_gives_way():
    constants = NODES["musashi_arm"]["biceps_drive"].constants
    assert 350.0 < constants.rated_torque * constants.gear / constants.spool_radius < 400.0


def test_the_pr2s_limits_are_clear_of_the_stops_and_of_the_highest_speeds():
    config, chain = ROBOTS["pr2_duster"], pr2_body.chain()
    low, high = config.bounds("joint_position")
    assert config.signals["joint_position"].elements == chain.joints
    assert (low > chain.low + 0.05).all()
    assert (high < chain.high - 0.05).all()
    assert (low + high) / 2 == pytest.approx(pr2_body.REST)
    assert config.limits["joint_position"].rate <= pr2_body.FASTEST.min()


def test_the_humanoids_drives_were_zeroed_at_the_rest_posture_within_the_limits():
    config, nodes = ROBOTS["kxr_humanoid"], NODES["kxr_humanoid"]
    zeros = [nodes[f"{joint}_drive"].constants.zero for joint in config.signals["joint_position"].elements]
    assert zeros == pytest.approx(kxr_body.REST)
    low, high = config.bounds("joint_position")
    assert np.all((low < kxr_body.REST) & (high > kxr_body.REST))


def test_the_humanoids_file_knows_where_the_cells_are_and_every_tool():
    config = ROBOTS["kxr_humanoid"]
    assert np.array(config.signals["center_of_gravity"].computed.settings["points"]) == pytest.approx(kxr_body.CELLS)
    assert kxr_humanoid.simulator.conditions == config.conditions
