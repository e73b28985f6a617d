"""`gemuco init`: from a URDF to a robot file that the demo plays without an edit."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from hal.config import load_robot
from services.demo.demo import control_of
from services.demo.stories import arm_story
from services.model.model_config import model_config

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tests" / "simulators"))
from test_urdf_arm import ARM, written  # noqa: E402


def gemuco(folder: Path, *words: str, timeout: float = 60.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, cwd=folder, check=False)


def named(folder: Path, name: str) -> Path:
    """An arm of a name of its own: services of another test may run."""
    return written(folder, ARM.replace("My Arm", name))


def test_a_robot_file_is_written_with_its_data_sheets(tmp_path: Path) -> None:
    completed = gemuco(tmp_path, "init", str(named(tmp_path, "My Arm")))
    assert completed.returncode == 0, completed.stderr
    assert completed.stdout.startswith("arm.yaml: 3 joints from base to tool0, reach 0.90 m")
    assert completed.stdout.endswith("Next: gemuco demo arm.yaml\n")
    assert sorted(path.name for path in (tmp_path / "eds").iterdir()) == ["joint_encoder.eds", "servo_drive.eds"]
    robot = load_robot(tmp_path / "arm.yaml")
    assert (robot.robot, robot.urdf) == ("my_arm", Path("arm.urdf"))
    again = gemuco(tmp_path, "init", "arm.urdf")
    assert again.returncode == 1
    assert again.stderr == "gemuco: 'arm.yaml' exists. Remove it, or name another file by --out.\n"


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (("none.urdf",), 2, "There is no file 'none.urdf'. Is its folder right?"),
        (("arm.urdf", "--tip", "nose"), 2, "has no link 'nose'. Known links, ends of chains first: tool0"),
        (("arm.urdf", "--name", "My Arm"), 2, "'My Arm' is no name of a robot"),
        (("arm.urdf", "--out", "arm.txt"), 1, "A robot file ends in .yaml, not as 'arm.txt'."),
        (("arm.xacro",), 2, "is a xacro file. Convert it first: xacro arm.xacro > robot.urdf"),
    ],
)
@pytest.mark.long
def test_what_cannot_be_is_refused_in_a_sentence(
    tmp_path: Path, words: tuple[str, ...], code: int, sentence: str
) -> None:
    named(tmp_path, "My Arm")
    written(tmp_path, ARM, "arm.xacro")
    answer = gemuco(tmp_path, "init", *words)
    assert answer.returncode == code
    assert sentence in answer.stderr
    assert len(answer.stderr.splitlines()) == 1
    assert not list(tmp_path.glob("*.yaml"))


@pytest.mark.long
def test_a_folder_of_files_becomes_a_robot_file(tmp_path: Path) -> None:
    (tmp_path / "vendors").mkdir()
    for name in ("eds/servo_drive.eds", "dbc/load_cell.dbc"):
        (tmp_path / "vendors" / Path(name).name).write_bytes((ROOT / "robots" / name).read_bytes())
    completed = gemuco(tmp_path, "init", "vendors")
    assert completed.returncode == 0, completed.stderr
    assert completed.stdout.startswith("vendors.yaml: devices: 2, of them drives: 1, elements: 5; lines to set: 3.\n")
    assert "Next: complete the lines with 'set' in vendors.yaml; then gemuco demo vendors.yaml" in completed.stdout
    robot = load_robot(tmp_path / "vendors.yaml")
    assert sorted(robot.devices) == ["cell", "servo_drive"]
    again = gemuco(tmp_path, "init", "vendors")
    assert again.stderr == "gemuco: 'vendors.yaml' exists. Remove it, or name another file by --out.\n"


@pytest.mark.slow
def test_an_mjcf_file_becomes_a_robot_file_with_its_urdf(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from test_mjcf import SCENE

    (tmp_path / "arm.xml").write_text(SCENE)
    completed = gemuco(tmp_path, "init", "arm.xml")
    assert completed.returncode == 0, completed.stderr
    assert completed.stdout.startswith("arm.yaml: 4 joints from base to tool_center")
    assert "Left out, because no motor moves it: cube." in completed.stdout
    robot = load_robot(tmp_path / "arm.yaml")
    assert (robot.urdf, robot.tip) == (Path("arm.urdf"), "tool_center")
    assert arm_story.reach_of(robot) > 0.7
    (tmp_path / "arm.yaml").unlink()
    assert gemuco(tmp_path, "init", "arm.xml").returncode == 0  # the same URDF may be there
    (tmp_path / "arm.yaml").unlink()
    (tmp_path / "arm.urdf").write_text("mine")
    again = gemuco(tmp_path, "init", "arm.xml")
    assert again.stderr.endswith(
        "arm.urdf' exists with another content. Remove it, or name a file elsewhere by --out.\n"
    )
    assert (tmp_path / "arm.urdf").read_text() == "mine"


def test_the_story_fits_arms_with_encoders_of_their_own(tmp_path: Path) -> None:
    assert gemuco(tmp_path, "init", str(named(tmp_path, "My Arm"))).returncode == 0
    robot = load_robot(tmp_path / "arm.yaml")
    assert control_of(robot).target == "joint_position"
    assert arm_story.encoders_of(robot, "joint_position")["elbow"] == "elbow_encoder"
    assert arm_story.encoders_of(robot, "motor_position") == {}
    assert arm_story.reach_of(robot) == pytest.approx(0.902, abs=1e-3)
    postures = arm_story.rests(robot, 0)
    low, high = robot.bounds("motor_position")
    assert all(((low <= posture) & (posture <= high)).all() for posture, _ in zip(postures, range(4), strict=False))
    for name in ("musashi_arm", "pr2_duster", "kxr_humanoid"):
        other = load_robot(ROOT / "robots" / f"{name}.yaml")
        assert not arm_story.fits(other, model_config(other).control)


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_the_demo_plays_an_arm_that_it_has_never_seen(tmp_path: Path) -> None:
    assert (
        gemuco(tmp_path, "init", str(named(tmp_path, f"arm {os.getpid()}")), "--name", f"arm_{os.getpid()}").returncode
        == 0
    )
    body = yaml.safe_load((tmp_path / "arm.yaml").read_text())
    body["collect"]["samples"] = 1000
    body["model"]["structure"] |= {"epochs": 30, "splits": 1}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(body, sort_keys=False))
    completed = gemuco(tmp_path, "demo", "arm.yaml", timeout=350.0)
    assert completed.returncode == 0, completed.stdout + completed.stderr
    for stage in ("moves to postures", "loses an encoder", "loses its sight"):
        assert stage in completed.stdout
    assert (tmp_path / "runs" / "demo" / "story.png").exists()
    assert (tmp_path / "runs" / f"arm_{os.getpid()}" / "model" / "manifest.json").exists()
