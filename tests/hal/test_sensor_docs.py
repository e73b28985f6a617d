"""The sections on sensors in docs/devices.md: their examples load, and their tables are those of the code."""

import re
from pathlib import Path

import pytest
import yaml
from hal_bench import ROBOTS

from hal.config import RobotConfig
from hal.drivers.canopen.analog import CELL_PRESETS, INPUT_PRESETS
from hal.robot import open_robot

TEXT = (Path(__file__).parents[2] / "docs" / "devices.md").read_text()
SENSORS = {
    "(`cia404`)": {"biceps_cell": ("force",), "back_cells": ("force_1", "force_2")},
    "(`cia401`)": {"biceps_cell": ("force",)},
    "(`cia406`)": {"elbow_encoder": ("position", "velocity")},
}


def section(title):
    return next(part for part in TEXT.split("\n## ") if title in part.partition("\n")[0])


@pytest.mark.parametrize("title", SENSORS)
def test_the_example_is_a_robot(title):
    example = yaml.safe_load(re.search(r"```yaml\n(.*?)```", section(title), re.DOTALL)[1])
    example["buses"]["can0"] = {"interface": "virtual", "channel": f"sensor_docs_{title}"}
    robot = open_robot(RobotConfig.model_validate({**example, "folder": ROBOTS}))
    found = {device.name: tuple(device.served) for device in robot._devices if not device.commands}
    assert found == SENSORS[title]


@pytest.mark.parametrize(("title", "presets"), [("(`cia404`)", CELL_PRESETS), ("(`cia401`)", INPUT_PRESETS)])
def test_every_preset_is_there(title, presets):
    for name, preset in presets.items():
        index = preset.form.value.index if title == "(`cia404`)" else preset.index
        assert re.search(rf"`{name}`[^\n]*{index:04X}h", section(title)), name
