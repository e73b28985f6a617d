"""Picture of the story of an arm."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from hal.config import RobotConfig
from services.demo.arm_story import ArmMarks
from services.demo.score_plot import draw_score
from services.demo.timeline import Timeline
from services.learning.plots import picture

GREY, RED, BLUE = "0.45", "tab:red", "tab:blue"


def plot(robot: RobotConfig, target: str, joints: Timeline, tip: Timeline, marks: ArmMarks, path: Path) -> None:
    """Draw the whole story into a PNG."""
    index = robot.signals[target].elements.index(marks.element)
    title = f"{robot.robot}: an encoder falls silent and comes back, the camera is covered and uncovered"
    with picture(path, title, rows=3, figsize=(13, 10), sharex=True) as axes:
        _joint(axes[0], joints, index, marks)
        _tip(axes[1], tip, marks)
        _anomaly(axes[2], joints)
        for axis in axes:
            for stage in marks.stages:
                axis.axvline(stage.start, color="0.85", linewidth=1, zorder=0)
            axis.grid(axis="y", color="0.93")
        for stage in marks.stages:
            axes[0].text(stage.start, 1.02, stage.name, transform=axes[0].get_xaxis_transform(), color=GREY, fontsize=9)
        axes[-1].set_xlabel("time [s]")


def _joint(axis: Axes, joints: Timeline, index: int, marks: ArmMarks) -> None:
    time, truth, value, estimated = _rows(joints, "time", "truth", "value", "estimated")
    axis.axvspan(*marks.silent, color="gold", alpha=0.3, label=f"{marks.encoder} silent")
    axis.plot(time, truth[:, index], color="black", linewidth=2.5, alpha=0.35, label="truth")
    axis.plot(time, value[:, index], color=BLUE, linewidth=1, label="published value")
    lost = np.where(estimated[:, index] > 0, value[:, index], np.nan)
    axis.plot(time, lost, color=RED, linewidth=2, label="of which estimated")
    axis.set_ylabel(f"{marks.element} [rad]")
    axis.legend(loc="lower left", ncols=4, fontsize=8)


def _tip(axis: Axes, tip: Timeline, marks: ArmMarks) -> None:
    time, truth, value, estimated = _rows(tip, "time", "truth", "value", "estimated")
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


def _rows(timeline: Timeline, *names: str) -> list[np.ndarray]:
    columns = [timeline.column(name) for name in names]
    rows = min(map(len, columns))
    return [column[:rows] for column in columns]
