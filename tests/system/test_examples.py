"""Every example that needs no running robot runs as its docstring says; the others say what they need."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments], capture_output=True, text=True, timeout=100, check=False
    )


def test_lost_sensor_is_estimated() -> None:
    done = run("lost_sensor.py")
    assert done.returncode == 0, done.stderr
    assert "mask says" in done.stdout


def test_a_tool_that_was_never_held_is_recognised() -> None:
    done = run("another_tool.py")
    assert done.returncode == 0, done.stderr
    before, after = (int(number) for number in re.findall(r"by (\d+) mm", done.stdout))
    assert before > 200
    assert after < 30


def test_arm_moves_without_a_bus() -> None:
    pytest.importorskip("pybullet", reason="the extra 'sim' is not installed")
    done = run("move_without_bus.py")
    assert done.returncode == 0, done.stderr
    assert "mode follow" in done.stdout


def test_watching_nobody_is_one_sentence() -> None:
    done = run("watch_estimates.py", "nobody_at_all", "1")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "gemuco serve nobody_at_all" in done.stderr
