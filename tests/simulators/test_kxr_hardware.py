"""The robot file against the simulated hardware, which shares no numbers with it."""

from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from simulators.nodes.spec import CellConstants, DriveConstants
from simulators.robots.kxr_humanoid import hardware, simulator
from simulators.robots.kxr_humanoid.body import CELLS, REST

CONFIG = load_robot(Path(__file__).parents[2] / "robots" / "kxr_humanoid.yaml")
NODES = {node.name: node for node in hardware()}


def test_every_device_hangs_where_the_robot_file_says():
    assert set(NODES) == set(CONFIG.devices)
    for name, device in CONFIG.devices.items():
        node = NODES[name]
        assert (node.bus, node.node, node.element) == (device.bus, device.node, device.element)
        assert CONFIG.settings_of(name)["eds"] == f"eds/{node.kind}.eds"


@pytest.mark.parametrize("name", list(NODES))
def test_the_robot_files_calibration_is_the_hardwares(name):
    constants, settings = NODES[name].constants, CONFIG.settings_of(name)
    if isinstance(constants, CellConstants):
        assert settings.get("zero", 0.0) == -constants.unbalance
        return
    assert isinstance(constants, DriveConstants)
    assert constants.spool_radius is None and "spool_radius" not in settings
    for key in ("counts_per_turn", "gear", "rated_torque"):
        assert settings[key] == getattr(constants, key)
    assert settings.get("direction", 1) == constants.direction
    assert settings.get("zero", 0.0) == constants.zero


def test_drives_were_zeroed_at_the_rest_posture():
    zeros = [NODES[f"{joint}_drive"].constants.zero for joint in CONFIG.signals["joint_position"].elements]
    assert zeros == pytest.approx(REST)


def test_the_robot_file_knows_where_the_cells_are():
    computed = CONFIG.signals["center_of_gravity"].computed
    assert computed is not None
    assert np.array(computed.settings["points"]) == pytest.approx(CELLS)


def test_tools_and_rest_posture_are_the_robot_files():
    assert simulator.conditions == CONFIG.conditions
    low, high = CONFIG.bounds("joint_position")
    assert np.all((low < REST) & (high > REST))
