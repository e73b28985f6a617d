"""Picture of the story of any devices."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from hal.config import RobotConfig
from services.demo.stories.device_story import DeviceMarks
from services.demo.stories.score_plot import draw_lost, draw_score, draw_stages
from services.demo.timeline import Timeline
from services.learning.plots import picture

BLUE = "tab:blue"


def plot(robot: RobotConfig, timeline: Timeline, marks: DeviceMarks, path: Path) -> None:
    """Draw the whole story into a PNG."""
    signal = robot.signals[marks.signal]
    title = f"{robot.robot}: {marks.device} falls silent and comes back"
    with picture(path, title, rows=3, figsize=(13, 10), sharex=True) as axes:
        label = f"{marks.signal}.{marks.element} [{signal.unit}]"
        draw_lost(axes[0], timeline, signal.elements.index(marks.element), label, marks.device, marks.silent)
        _commands(axes[1], robot, timeline)
        draw_score(axes[2], timeline, BLUE)
        axes[2].legend(loc="lower left", fontsize=8)
        draw_stages(axes, marks.stages)


def _commands(axis: Axes, robot: RobotConfig, timeline: Timeline) -> None:
    signal = robot.signals[robot.command.signal]
    time, applied = (timeline.column(name) for name in ("time", "applied"))
    rows = min(len(time), len(applied))
    for index, element in enumerate(signal.elements):
        axis.plot(time[:rows], np.asarray(applied[:rows], float)[:, index], linewidth=1, label=element)
    axis.set_ylabel(f"commanded {robot.command.signal} [{signal.unit}]")
    if signal.size <= 8:
        axis.legend(loc="lower left", ncols=4, fontsize=8)
