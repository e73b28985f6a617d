"""The sections on DBC files and ODrive in docs/devices.md: the examples are robots, the tables name every setting."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from hal_bench import Bench

from hal.config import RobotConfig
from hal.drivers.dbc.settings import DbcSettings, ServoSettings
from hal.drivers.odrive import OdriveSettings
from hal.robot import open_robot
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.dbc_cell import DbcCellConstants
from simulators.nodes.odrive import OdriveConstants
from simulators.robots.bench import hardware
from simulators.robots.bench.world import BenchWorld

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "devices.md").read_text()
ANY = TEXT[TEXT.index("## Any node with a DBC file") :].split("\n## ")[0]
ODRIVE = TEXT[TEXT.index("## ODrive") :].split("\n## ")[0]


def robot_file(section):
    example = yaml.safe_load(re.search(r"```yaml\n(.*?)```", section, re.DOTALL)[1])
    example["buses"] = {"can0": {"interface": "virtual", "channel": f"docs_{example['robot']}"}}
    return RobotConfig.model_validate({**example, "folder": ROOT / "robots"})


def listed(section):
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return {name for row in rows for name in re.findall(r"`(\w+)`", row)}


def test_every_setting_is_in_a_table():
    inherited = {"silent_after"}
    assert listed(ANY) == set(ServoSettings.model_fields) - inherited
    assert set(DbcSettings.model_fields) < set(ServoSettings.model_fields)
    own = set(OdriveSettings.model_fields) - set(ServoSettings.model_fields)
    assert own <= listed(ODRIVE) <= set(OdriveSettings.model_fields)


def test_a_servo_and_a_cell_of_the_example_work():
    config = robot_file(ANY)
    nodes = [
        NodeSpec("left_cell", "can0", 7, "wire_force.left", DbcCellConstants()),
        NodeSpec("winch_axis", "can0", 3, "joint_position.winch", OdriveConstants()),
    ]
    bench = Bench(config, nodes=nodes, world=BenchWorld(config)).open()
    try:
        bench.until(lambda: bench.device("winch_axis")["state"] == "ready", "ready", 400)
        bench.world.break_part("set:wire_force.left:42")
        bench.enable()
        bench.follow(np.array([0.3]), 120)
        assert bench.sample.values["joint_position"] == pytest.approx(0.3, abs=2e-3)  # rad
        assert bench.sample.values["wire_force"] == pytest.approx(42.0, abs=1e-3)  # N
        bench.robot.disable()
        bench.until(lambda: bench.robot.mode == "off", "off", 100)
        assert bench.rig.node("winch_axis").condition == "idle"
    finally:
        bench.close()


def test_an_axis_of_the_example_works_on_the_bench():
    config = robot_file(ODRIVE)
    bench = Bench(config, nodes=hardware(config), world=BenchWorld(config)).open()
    try:
        bench.until(lambda: bench.device("elbow_axis")["state"] == "ready", "ready", 400)
        assert bench.rig.node("elbow_axis")._limits == pytest.approx((8.0, 1.2))  # turns/s, N m
        bench.cycle(110)
        assert all(valid.all() for valid in bench.sample.valid.values())
        bench.enable()
        bench.follow(np.array([0.2]), 120)
        assert bench.sample.values["joint_position"] == pytest.approx(0.2, abs=2e-3)  # rad
    finally:
        bench.close()


def test_the_budget_counts_what_the_axis_sends():
    config = robot_file(ODRIVE)
    axis = open_robot(config)._devices[0]
    sent = sum(frames.rate for frames in type(axis).traffic_of(axis._settings, 200.0, (), config.folder))
    assert sent == pytest.approx(10 + 100 + 50 + 2 + 200)  # frames per second
