"""Picture of the story of a robot with tools."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from gemuco.adaption.recognise import Prior
from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.demo.stories.score_plot import draw_score
from services.demo.stories.tool_story import ToolMarks
from services.demo.timeline import Timeline
from services.learning.plots import picture

GREY, RED, GREEN, BLUE = "0.45", "tab:red", "tab:green", "tab:blue"


def plot(robot: RobotConfig, signal: str, schema: BodySchema, timeline: Timeline, marks: ToolMarks, path: Path) -> None:
    """Draw the whole story of a signal into a PNG."""
    old, new = marks.conditions
    title = f"{robot.robot}: the camera is covered, and {new} replaces {old} in the hand"
    with picture(path, title, rows=5, figsize=(13, 15), sharex=True) as axes:
        _tip(axes[0], robot.signals[signal].elements, timeline, marks)
        _miss(axes[1], timeline, marks)
        _hidden_error(axes[2], timeline)
        _bias(axes[3], schema, timeline, marks)
        _anomaly(axes[4], timeline)
        for axis in axes:
            _stages(axis, marks)
        at = axes[0].get_xaxis_transform()
        for index, stage in enumerate(marks.stages):
            height = 1.02 + 0.06 * (index % 2)
            axes[0].text(stage.start, height, stage.name, transform=at, color=GREY, fontsize=9)
        axes[0].set_ylabel(f"{signal} [{robot.signals[signal].unit}]")
        axes[-1].set_xlabel("time [s]")


def _stages(axis: Axes, marks: ToolMarks) -> None:
    for stage in marks.stages:
        axis.axvline(stage.start, color="0.85", linewidth=1, zorder=0)
    for span in marks.adapting:
        axis.axvspan(*span, color=GREEN, alpha=0.1, linewidth=0)
    axis.axvspan(*marks.covered, color="gold", alpha=0.2, linewidth=0)
    axis.axvline(marks.changed, color=RED, linewidth=1, linestyle=":")
    axis.grid(axis="y", color="0.93")


def _tip(axis: Axes, elements: tuple[str, ...], timeline: Timeline, marks: ToolMarks) -> None:
    time, truth, value, estimated = (timeline.column(name) for name in ("time", "truth", "value", "estimated"))
    rows = min(map(len, (time, truth, value, estimated)))
    for index, element in enumerate(elements):
        line = axis.plot(time[:rows], truth[:rows, index], linewidth=4, alpha=0.3, label=f"{element}, truth")[0]
        axis.plot(time[:rows], value[:rows, index], color=line.get_color(), linewidth=1)
        estimates = np.where(estimated[:rows, index] > 0, value[:rows, index], np.nan)
        axis.plot(time[:rows], estimates, color=RED, linewidth=1.5, label=None if index else "published as estimated")
    at = [moment for moment, _ in marks.targets] + [timeline.now()]
    for (start, target), end in zip(marks.targets, at[1:], strict=True):
        axis.hlines(target, start, min(end, time[-1]), color="black", linewidth=0.7, linestyle=(0, (4, 3)))
    axis.legend(loc="lower left", ncols=len(elements) + 1, fontsize=8)


def _miss(axis: Axes, timeline: Timeline, marks: ToolMarks) -> None:
    time, truth = timeline.column("time"), timeline.column("truth")
    rows = min(len(time), len(truth))
    away = np.full(rows, np.nan)
    for start, target in marks.targets:
        later = time[:rows] >= start
        away[later] = 1e3 * np.linalg.norm(truth[:rows][later] - target, axis=1)
    axis.plot(time[:rows], away, color="0.75", linewidth=1, label="tip to target")
    moments, errors = np.array(marks.reached).reshape(-1, 2).T
    axis.plot(moments, 1e3 * errors, "o", color=BLUE, label="measured at the end of each move")
    for stage in marks.stages:
        inside = (moments >= stage.start) & (moments <= stage.end)
        if inside.any():
            mean = 1e3 * float(errors[inside].mean())
            axis.hlines(mean, moments[inside][0], stage.end, color=BLUE, linewidth=2)
            axis.annotate(f"{mean:.0f} mm", (stage.end, mean), (-4, 6), textcoords="offset points", ha="right")
    axis.set_ylabel("distance [mm]")
    axis.set_ylim(bottom=0.0)
    axis.legend(loc="upper left", fontsize=8)


def _hidden_error(axis: Axes, timeline: Timeline) -> None:
    time, error = timeline.column("hidden_time"), timeline.column("hidden_error")
    rows = min(len(time), len(error))
    axis.semilogy(time[:rows], 1e3 * error[:rows], color=GREY, linewidth=1, label="tip as inferred without the camera")
    axis.set_ylabel("true error [mm]")
    axis.legend(loc="upper left", fontsize=8)


def _bias(axis: Axes, schema: BodySchema, timeline: Timeline, marks: ToolMarks) -> None:
    prior = Prior.of(schema)
    time = np.array([at for at, _ in timeline.updates])
    for name, known in zip(schema.biases, prior.known, strict=True):
        away = [prior.between(update.bias, known) for _, update in timeline.updates]
        is_played = name in marks.conditions
        axis.plot(
            time, away, linewidth=2 if is_played else 1, color=None if is_played else "0.85",
            label=name if is_played else None, zorder=2 if is_played else 1,
        )  # fmt: skip
    axis.set_ylabel("p to known tools [std]")
    axis.set_ylim(bottom=0.0)
    axis.legend(loc="best", fontsize=8)


def _anomaly(axis: Axes, timeline: Timeline) -> None:
    time, score, verdict = (timeline.column(name) for name in ("time", "score", "verdict"))
    rows = min(map(len, (time, score, verdict)))
    draw_score(axis, timeline, GREY)
    for word, color in (("environment", BLUE), ("anomaly", RED)):
        at = verdict[:rows] == word
        axis.plot(time[:rows][at], score[:rows][at], ".", color=color, markersize=4, label=f"verdict {word}")
    axis.legend(loc="lower left", ncols=4, fontsize=8)
