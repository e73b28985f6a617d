"""From the files of vendors to a lost sensor that is estimated: `gemuco init` and `gemuco demo`, without an edit."""

import os
import re
import subprocess
from pathlib import Path

import pytest
from arm_stack import ROOT

from hal.config import load_robot
from services.demo.stories.choice import story_of
from services.demo.stories.device_story import fits, lost_device
from services.model.model_config import model_config
from services.process.supervisor import gemuco_command

CAR = """VERSION ""
BU_: Brakes Host
BO_ {first} Wheels: 8 Brakes
 SG_ Left : 0|16@1+ (0.01,0) [0|300] "km/h" Host
 SG_ Right : 16|16@1+ (0.01,0) [0|300] "km/h" Host
 SG_ Angle : 32|16@1- (0.1,0) [-700|700] "deg" Host
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ {first} 20;
"""
PATIENCE = 300.0
"""The demo takes this long [s] at most, on a machine with other work."""


def drafted(folder: Path, *files: tuple[str, str]) -> Path:
    """Return the robot file that `gemuco init` drafts from files."""
    (folder / "vendors").mkdir()
    for name, text in files:
        (folder / "vendors" / name).write_text(text)
    file = folder / f"vendors_{os.getpid()}.yaml"
    run("init", "vendors", "--out", file.name, folder=folder)
    return file


def run(*words: str, folder: Path) -> str:
    done = subprocess.run(
        gemuco_command(*words), cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr
    return done.stdout


@pytest.mark.slow
def test_files_of_vendors_become_a_robot_whose_lost_sensor_is_estimated(tmp_path: Path) -> None:
    drive = (ROOT / "robots" / "eds" / "servo_drive.eds").read_text()
    file = drafted(
        tmp_path, ("drive.eds", drive), ("front.dbc", CAR.format(first=769)), ("rear.dbc", CAR.format(first=769))
    )
    robot = load_robot(file)
    assert len(robot.buses) == 2
    output = " ".join(run("demo", file.name, folder=tmp_path).split())
    assert "measured again when the node came back" in output
    error = re.search(r"meanwhile: mean \S+ m/s, ([\d.]+)% of the range", output.replace(" %", "%"))
    assert error is not None, output[-3000:]
    assert float(error[1]) < 10.0
    assert (tmp_path / "runs" / robot.robot).is_dir()
    assert list(tmp_path.rglob("story.png"))


@pytest.mark.long
def test_the_story_loses_a_sensor_or_else_a_drive_that_another_device_replaces(tmp_path: Path) -> None:
    drive = (ROOT / "robots" / "eds" / "servo_drive.eds").read_text()
    both = load_robot(drafted(tmp_path, ("drive.eds", drive), ("front.dbc", CAR.format(first=769))))
    marks = lost_device(both)
    assert (marks.device, marks.signal, marks.element) == ("brakes", "speed", "brakes_left")
    assert not marks.is_drive
    assert story_of(both).names == ("moves its drives", "loses a sensor")
    (tmp_path / "two").mkdir()
    two = load_robot(drafted(tmp_path / "two", ("a.eds", drive), ("b.eds", drive)))
    marks = lost_device(two)
    assert (marks.device, marks.signal, marks.element) == ("b", "joint_position", "b")
    assert marks.is_drive
    (tmp_path / "one").mkdir()
    one = load_robot(drafted(tmp_path / "one", ("a.eds", drive)))
    assert not fits(one, model_config(one).control)
