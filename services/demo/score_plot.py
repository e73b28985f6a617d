"""Anomaly score and threshold over time, as every story draws them."""

from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from services.demo.timeline import Timeline

RED = "tab:red"


def draw_score(axis: Axes, timeline: Timeline, color: str) -> None:
    """Draw the score in a color, and its threshold, on a logarithmic axis with plain numbers."""
    time, score, threshold = (timeline.column(name) for name in ("time", "score", "threshold"))
    rows = min(map(len, (time, score, threshold)))
    axis.semilogy(time[:rows], score[:rows], color=color, linewidth=1, label="anomaly score")
    axis.semilogy(time[:rows], threshold[:rows], color=RED, linewidth=1.5, linestyle="--", label="threshold")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(LogFormatter())  # where there is less than a decade
    axis.set_ylabel("Mahalanobis distance")
