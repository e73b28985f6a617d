"""The robot file against the simulated hardware, which shares no numbers with it."""

from pathlib import Path

import pytest

from hal.config import load_robot
from simulators.nodes.spec import DriveConstants, EncoderConstants
from simulators.robots.musashi_arm import hardware, simulator

CONFIG = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")
NODES = {node.name: node for node in hardware()}


def test_every_device_hangs_where_the_robot_file_says():
    assert set(NODES) == set(CONFIG.devices)
    for name, device in CONFIG.devices.items():
        node = NODES[name]
        assert (node.bus, node.node, node.element) == (device.bus, device.node, device.element)
        assert CONFIG.settings_of(name)["eds"] == f"eds/{node.kind}.eds"


@pytest.mark.parametrize("name", [name for name in NODES if name.endswith(("_drive", "_encoder"))])
def test_the_robot_files_calibration_is_the_hardwares(name):
    constants, settings = NODES[name].constants, CONFIG.settings_of(name)
    assert isinstance(constants, DriveConstants | EncoderConstants)
    for key in ("counts_per_turn", "gear", "spool_radius", "rated_torque"):
        if hasattr(constants, key):
            assert settings[key] == getattr(constants, key)
    assert settings.get("direction", 1) == constants.direction
    assert settings["zero"] == pytest.approx(constants.zero, abs=1e-6)


def test_a_muscles_drive_and_cell_share_a_bus():
    for element in CONFIG.signals["muscle_length"].elements:
        assert NODES[f"{element}_drive"].bus == NODES[f"{element}_cell"].bus


def test_drives_were_zeroed_at_about_the_rest_posture():
    world = simulator.world("geometric", 0)
    rest = dict(zip(CONFIG.signals["muscle_length"].elements, world.truth()["muscle_length"], strict=True))
    world.close()
    for name, node in NODES.items():
        if isinstance(node.constants, DriveConstants):
            assert node.constants.zero == pytest.approx(rest[name.removesuffix("_drive")], abs=0.005)


def test_drives_are_strong_enough_for_the_tension_at_which_the_spool_gives_way():
    constants = NODES["biceps_drive"].constants
    assert isinstance(constants, DriveConstants)
    rated_tension = constants.rated_torque * constants.gear / constants.spool_radius
    assert 350.0 < rated_tension < 400.0
