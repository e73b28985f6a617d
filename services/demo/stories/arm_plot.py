"""Picture of the story of an arm."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from hal.config import RobotConfig
from services.demo.stories.arm_story import ArmMarks
from services.demo.stories.score_plot import draw_lost, draw_score, draw_stages, rows_of
from services.demo.timeline import Timeline
from services.learning.plots import picture

GREY, RED, BLUE = "0.45", "tab:red", "tab:blue"


def plot(robot: RobotConfig, target: str, joints: Timeline, tip: Timeline, marks: ArmMarks, path: Path) -> None:
    """Draw the whole story into a PNG."""
    index = robot.signals[target].elements.index(marks.element)
    title = f"{robot.robot}: an encoder falls silent and comes back, the camera is covered and uncovered"
    with picture(path, title, rows=3, figsize=(13, 10), sharex=True) as axes:
        draw_lost(axes[0], joints, index, f"{marks.element} [rad]", marks.encoder, marks.silent)
        _tip(axes[1], tip, marks)
        _anomaly(axes[2], joints)
        draw_stages(axes, marks.stages)


def _tip(axis: Axes, tip: Timeline, marks: ArmMarks) -> None:
    time, truth, value, estimated = rows_of(tip, "time", "truth", "value", "estimated")
    error = 1e3 * np.linalg.norm(value - truth, axis=1)
    lost = estimated.any(axis=1)
    axis.axvspan(*marks.covered, color="gold", alpha=0.3, label="camera covered")
    axis.plot(time, np.where(lost, np.nan, error), color=BLUE, linewidth=1, label="measured by the camera")
    axis.plot(time, np.where(lost, error, np.nan), color=RED, linewidth=2, label="estimated from the arm")
    axis.axhline(30.0 * marks.reach, color=GREY, linestyle="--", linewidth=1, label="3 % of the reach")
    axis.set_ylabel("true error of the tip [mm]")
    axis.set_ylim(bottom=0.0)
    axis.legend(loc="upper left", ncols=4, fontsize=8)


def _anomaly(axis: Axes, joints: Timeline) -> None:
    draw_score(axis, joints, BLUE)
    axis.legend(loc="lower left", fontsize=8)
