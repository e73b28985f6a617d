"""The snippets of README.md, run as they stand."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from hal.config import RobotConfig
from hal.robot import open_robot

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_the_first_program_prints_what_the_page_shows() -> None:
    program, shown = re.search(r"```python\n(.*?)```\n\n```\n(.*?)```", TEXT, re.DOTALL).groups()
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    number = r"\d\.\d+"
    padded = number + " *"  # numpy pads a number whose last digit is 0
    assert re.sub(padded, "# ", done.stdout) == re.sub(padded, "# ", shown)
    printed, expected = ([float(text) for text in re.findall(number, line)] for line in (done.stdout, shown))
    assert printed == pytest.approx(expected, abs=0.02)  # rad; the last digit differs between processors
    assert len([line for line in program.splitlines() if line]) == 12


def test_the_robot_file_is_a_robot() -> None:
    text = re.search(r"```yaml\n(.*?)```", TEXT, re.DOTALL)[1]
    assert len(text.splitlines()) == 8
    description = yaml.safe_load(text)
    description["buses"]["can0"] = {"interface": "virtual", "channel": "readme"}
    robot = open_robot(RobotConfig.model_validate({**description, "folder": ROOT / "robots"}))
    assert [device.name for device in robot._devices] == ["elbow_drive"]


def test_the_page_is_short() -> None:
    assert len(TEXT.splitlines()) <= 130
