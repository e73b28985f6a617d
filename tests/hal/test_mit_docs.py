"""The section on MIT mode in docs/devices.md: its example loads, and its table is the one in the code."""

import re
from pathlib import Path

import yaml

from hal.config import RobotConfig
from hal.protocols import mit_motors
from hal.robot import open_robot

TEXT = (Path(__file__).parents[2] / "docs" / "devices.md").read_text()
SECTION = TEXT[TEXT.index("## Drives in MIT mode") :].split("\n## ")[0]
SOURCES = (mit_motors.CUBEMARS, mit_motors.OPENARM, mit_motors.DAMIAO_DRIVER, mit_motors.MINI_CHEETAH)


def row(name):
    """What the table says of a motor."""
    motor = mit_motors.MOTORS[name]
    ranges = motor.ranges
    numbers = f"{ranges.position:g} | {ranges.velocity:g} | {ranges.effort:g}"
    return f"| `{name}` | {motor.layout.value} | {numbers} | {SOURCES.index(motor.source) + 1} | {motor.note} |"


def test_the_example_is_a_robot():
    example = yaml.safe_load(re.search(r"```yaml\n(.*?)```", SECTION, re.DOTALL)[1])
    example["buses"] = {"can0": {"interface": "virtual", "channel": "mit_docs"}}
    robot = open_robot(RobotConfig.model_validate(example))
    assert [device.name for device in robot._devices] == ["elbow_drive", "finger_drive"]
    assert robot._devices[1].commands == ("joint_position.finger",)


def test_the_table_is_that_of_the_code():
    listed = [line for line in SECTION.splitlines() if line.startswith("| `") and line.count("|") == 8]
    assert listed == [row(name) for name in mit_motors.MOTORS]


def test_every_source_is_named():
    for number, source in enumerate(SOURCES, 1):
        assert f"{number} {source}." in SECTION
    ranges = {(motor.ranges.stiffness, motor.ranges.damping) for motor in mit_motors.MOTORS.values()}
    assert ranges == {(500.0, 5.0)}
