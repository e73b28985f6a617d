"""The robot file of the PR2 against the simulated hardware, which shares no numbers with it."""

from pathlib import Path

import pytest

from hal.config import load_robot
from simulators.nodes.spec import DriveConstants
from simulators.robots.pr2_duster import hardware, simulator
from simulators.robots.pr2_duster.body import FASTEST, REST, chain

CONFIG = load_robot(Path(__file__).parents[2] / "robots" / "pr2_duster.yaml")
NODES = {node.name: node for node in hardware()}


def test_every_device_hangs_where_the_robot_file_says():
    assert set(NODES) == set(CONFIG.devices)
    for name, device in CONFIG.devices.items():
        node = NODES[name]
        assert (node.bus, node.node, node.element) == (device.bus, device.node, device.element)
        assert CONFIG.settings_of(name)["eds"] == f"eds/{node.kind}.eds"


@pytest.mark.parametrize("name", NODES)
def test_the_robot_files_calibration_is_the_hardwares(name):
    constants, settings = NODES[name].constants, CONFIG.settings_of(name)
    assert isinstance(constants, DriveConstants)
    assert settings["counts_per_turn"] == constants.counts_per_turn
    assert settings["gear"] == constants.gear
    assert "spool_radius" not in settings
    assert constants.spool_radius is None
    assert settings.get("direction", 1) == constants.direction
    assert settings["zero"] == pytest.approx(constants.zero, abs=1e-6)


def test_the_robot_files_limits_are_clear_of_the_stops_and_of_the_highest_speeds():
    low, high = CONFIG.bounds("joint_position")
    assert CONFIG.signals["joint_position"].elements == chain().joints
    assert (low > chain().low + 0.05).all()
    assert (high < chain().high - 0.05).all()
    assert (low + high) / 2 == pytest.approx(REST)
    assert CONFIG.limits["joint_position"].rate <= FASTEST.min()


def test_the_simulator_knows_every_condition_of_the_robot_file():
    assert set(CONFIG.conditions) <= set(simulator.conditions)
