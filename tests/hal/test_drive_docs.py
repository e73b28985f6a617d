"""The section on CiA 402 in docs/devices.md: its examples load, and its table names every setting."""

import re
from pathlib import Path

import yaml
from hal_bench import ROBOTS

from hal.commissioning.pdo_map import PdoSettings
from hal.config import RobotConfig
from hal.drivers.cia402.settings import DriveSettings
from hal.robot import open_robot

TEXT = (Path(__file__).parents[2] / "docs" / "devices.md").read_text()
SECTION = TEXT[TEXT.index("(`cia402`)") :]
SECTION = SECTION[: SECTION.index("\n## ")]
EXAMPLE, PDO = (yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", SECTION, re.DOTALL))


def test_the_example_by_velocity_loads():
    robot = open_robot(RobotConfig.model_validate({**EXAMPLE, "folder": ROBOTS}))
    (drive,) = robot._devices
    assert drive.commands == ("joint_velocity.elbow",)
    assert set(drive.served) == {"velocity", "position", "effort", "temperature"}


def test_the_example_by_torque_loads():
    changes = {"command": {"signal": "joint_effort"}, "stop": {"behaviour": "damp"}, "folder": ROBOTS}
    body = {**EXAMPLE, **changes, "limits": {"joint_effort": {"low": -5, "high": 5}}}
    body["kinds"]["drive"]["settings"] |= {"mode": "cst", "damping": 0.8}
    (drive,) = open_robot(RobotConfig.model_validate(body))._devices
    assert drive.commands == ("joint_effort.elbow",)
    assert drive.can_damp


def test_the_layout_loads():
    pdos = PdoSettings.model_validate(PDO["pdo"]).map("it")
    assert pdos.is_fixed
    assert [pdo.size for pdo in (*pdos.receives, *pdos.sends)] == [6, 8]


def test_the_table_names_every_setting():
    rows = re.findall(r"^\| (`.*?) \|", SECTION, re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert named == set(DriveSettings.model_fields) - {"eds", "silent_after"}
