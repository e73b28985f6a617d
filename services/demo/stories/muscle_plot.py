"""Picture of the story."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from hal.config import RobotConfig
from services.demo.stories.muscle_story import MUSCLE, SILENT_ELEMENT, Marks
from services.demo.stories.score_plot import draw_score
from services.demo.timeline import Timeline
from services.learning.plots import picture

GREY, RED, GREEN, BLUE = "0.45", "tab:red", "tab:green", "tab:blue"


def plot(robot: RobotConfig, timeline: Timeline, marks: Marks, path: Path) -> None:
    """Draw the whole story into a PNG."""
    title = f"{robot.robot}: a minute with a lost sensor, an online update and a cut muscle"
    with picture(path, title, rows=4, figsize=(13, 13), sharex=True) as axes:
        _silent_joint(axes[0], robot, timeline, marks)
        _hidden_error(axes[1], timeline, marks)
        _anomaly(axes[2], timeline, marks)
        _command(axes[3], robot, timeline)
        for axis in axes:
            _stages(axis, marks)
        at = axes[0].get_xaxis_transform()
        for index, stage in enumerate(marks.stages):
            axes[0].text(stage.start, 1.02 + 0.06 * (index % 2), stage.name, transform=at, color=GREY, fontsize=9)
        axes[-1].set_xlabel("time [s]")


def _stages(axis: Axes, marks: Marks) -> None:
    for stage in marks.stages:
        axis.axvline(stage.start, color="0.85", linewidth=1, zorder=0)
    axis.axvline(marks.cut, color=RED, linewidth=1, linestyle=":")
    axis.grid(axis="y", color="0.93")


def _silent_joint(axis: Axes, robot: RobotConfig, timeline: Timeline, marks: Marks) -> None:
    index = robot.signals["joint_position"].elements.index(SILENT_ELEMENT)
    time, truth, value = timeline.column("time"), timeline.column("truth"), timeline.column("value")
    rows = min(map(len, (time, truth, value)))
    estimated = timeline.column("estimated")[:rows, index] > 0
    axis.axvspan(*marks.silent, color="gold", alpha=0.3, label="encoder silent")
    axis.plot(time[:rows], truth[:rows, index], color="black", linewidth=2.5, alpha=0.35, label="truth")
    axis.plot(time[:rows], value[:rows, index], color=BLUE, linewidth=1, label="published value")
    estimates = np.where(estimated, value[:rows, index], np.nan)
    axis.plot(time[:rows], estimates, color=RED, linewidth=2, label="of which estimated")
    axis.set_ylabel(f"{SILENT_ELEMENT} [rad]")
    axis.legend(loc="lower left", ncols=4, fontsize=8)


def _hidden_error(axis: Axes, timeline: Timeline, marks: Marks) -> None:
    time, error = timeline.column("hidden_time"), timeline.column("hidden_error")
    rows = min(len(time), len(error))
    axis.axvspan(*marks.learning, color="tab:green", alpha=0.15, label="online update")
    axis.plot(time[:rows], error[:rows], color=GREY, linewidth=1, label="error of the estimate, all encoders hidden")
    first, last = marks.stages[0], marks.stages[min(2, len(marks.stages) - 1)]
    label = "mean at test poses"
    axis.hlines(marks.error_before, first.start, first.end, color=RED, linewidth=2, label=f"{label} before")
    axis.hlines(marks.error_after, marks.learning[1], last.end, color=GREEN, linewidth=2, label=f"{label} after")
    axis.set_ylabel("norm of 5 joints [rad]")
    axis.set_ylim(bottom=0.0)
    axis.legend(loc="upper left", ncols=2, fontsize=8)


def _anomaly(axis: Axes, timeline: Timeline, marks: Marks) -> None:
    draw_score(axis, timeline, BLUE)
    blamed = f"{MUSCLE} cut; muscle with the largest part: {marks.blamed or 'none'}"
    axis.annotate(blamed, (marks.cut, 0.92), xycoords=axis.get_xaxis_transform(), ha="right", color=RED, fontsize=9)
    axis.legend(loc="lower left", fontsize=8)


def _command(axis: Axes, robot: RobotConfig, timeline: Timeline) -> None:
    time, applied = timeline.column("time"), timeline.column("applied")
    rows = min(len(time), len(applied))
    for index, muscle in enumerate(robot.signals[robot.command.signal].elements):
        axis.plot(time[:rows], applied[:rows, index], linewidth=1, label=muscle)
    axis.set_ylabel("applied length [m]")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=10, fontsize=7, frameon=False)
