"""Rows that several stories draw: an element that is lost, the anomaly score, and where the stages begin."""

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from services.demo.actor import Stage
from services.demo.timeline import Timeline

GREY, RED, BLUE = "0.45", "tab:red", "tab:blue"


def rows_of(timeline: Timeline, *names: str) -> list[np.ndarray]:
    """Return columns of a timeline, all as long as the shortest."""
    columns = [timeline.column(name) for name in names]
    rows = min(map(len, columns))
    return [column[:rows] for column in columns]


def draw_lost(axis: Axes, timeline: Timeline, index: int, label: str, device: str, silent: tuple[float, float]) -> None:
    """Draw an element of the timeline's signal; its device was silent from a time to another [s]."""
    time, truth, value, estimated = rows_of(timeline, "time", "truth", "value", "estimated")
    axis.axvspan(*silent, color="gold", alpha=0.3, label=f"{device} silent")
    axis.plot(time, truth[:, index], color="black", linewidth=2.5, alpha=0.35, label="truth")
    axis.plot(time, value[:, index], color=BLUE, linewidth=1, label="published value")
    lost = np.where(estimated[:, index] > 0, value[:, index], np.nan)
    axis.plot(time, lost, color=RED, linewidth=2, label="of which estimated")
    axis.set_ylabel(label)
    axis.legend(loc="best", ncols=4, fontsize=8)


def draw_score(axis: Axes, timeline: Timeline, color: str) -> None:
    """Draw the score in a color, and its threshold, on a logarithmic axis with plain numbers."""
    time, score, threshold = rows_of(timeline, "time", "score", "threshold")
    axis.semilogy(time, score, color=color, linewidth=1, label="anomaly score")
    axis.semilogy(time, threshold, color=RED, linewidth=1.5, linestyle="--", label="threshold")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(LogFormatter())  # where there is less than a decade
    axis.set_ylabel("Mahalanobis distance")


def draw_stages(axes: Sequence[Axes], stages: Iterable[Stage]) -> None:
    """Draw a line where each stage begins, and its name above the first row."""
    for stage in stages:
        for axis in axes:
            axis.axvline(stage.start, color="0.85", linewidth=1, zorder=0)
        axes[0].text(stage.start, 1.02, stage.name, transform=axes[0].get_xaxis_transform(), color=GREY, fontsize=9)
    for axis in axes:
        axis.grid(axis="y", color="0.93")
    axes[-1].set_xlabel("time [s]")
