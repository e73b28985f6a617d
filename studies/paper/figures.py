"""Kinds of figures that the experiments share, drawn into PNG files."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from services.learning import plots


def picture(path: Path, title: str, columns: int = 1, rows: int = 1) -> AbstractContextManager[list[Axes]]:
    """Return a context of axes to draw on, of equal size; the PNG is written at its end."""
    return plots.picture(path, title, rows, columns, figsize=(6.4 * columns, 4.6 * rows))


def bias_map(axis: Axes, biases: Mapping[str, np.ndarray], paths: Mapping[str, np.ndarray] | None = None) -> None:
    """Draw the p of every condition in the plane of their two principal components, and paths of p.

    Args:
        axis: The axis to draw on.
        biases: Condition -> p, shape (bias_size,).
        paths: Label -> the p of every step, shape (steps, bias_size).
    """
    center, plane = _principal_plane(np.stack(list(biases.values())))
    for condition, p in biases.items():
        x, y = (p - center) @ plane
        axis.plot(x, y, "o", color="black", markersize=5)
        axis.annotate(condition, (x, y), textcoords="offset points", xytext=(5, 4), fontsize=8)
    for label, steps in (paths or {}).items():
        x, y = ((np.asarray(steps) - center) @ plane).T
        (line,) = axis.plot(x, y, ".-", linewidth=1, markersize=3, label=label)
        axis.plot(x[0], y[0], "s", color=line.get_color())
        axis.plot(x[-1], y[-1], "*", color=line.get_color(), markersize=11)
    if paths:
        axis.legend(fontsize=8, title="from square to star", title_fontsize=8)
    axis.set_xlabel("first principal component of p")
    axis.set_ylabel("second")
    axis.grid(color="0.93")


def _principal_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (k,) and the two directions of largest spread as columns (k, 2)."""
    center = points.mean(axis=0)
    _, _, directions = np.linalg.svd(points - center, full_matrices=True)
    plane = np.zeros((points.shape[1], 2))
    plane[:, : min(2, len(directions))] = directions[:2].T
    return center, plane


def over_steps(
    axis: Axes, curves: Mapping[str, np.ndarray], unit: str, steps: str = "step", bar: float | None = None
) -> None:
    """Draw errors over steps or time: mean over the runs, and a band from the least to the largest.

    Args:
        axis: The axis to draw on.
        curves: Label -> error [unit], shape (runs, steps); NaN where no error was measured.
        unit: Unit of the errors.
        steps: Label of the steps.
        bar: Limit to reach [unit].
    """
    for label, values in curves.items():
        runs = np.atleast_2d(values)
        count = np.arange(1, runs.shape[1] + 1)
        (line,) = axis.plot(count, np.nanmean(runs, axis=0), label=label)
        if len(runs) > 1:
            low, high = np.nanmin(runs, axis=0), np.nanmax(runs, axis=0)
            axis.fill_between(count, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
    if bar is not None:
        axis.axhline(bar, color="0.4", linestyle="--", linewidth=1, label="to reach")
    axis.set_xlabel(steps)
    axis.set_ylabel(f"error [{unit}]")
    axis.set_ylim(bottom=0.0)
    axis.legend(fontsize=8)
    axis.grid(color="0.93")


def bars(axis: Axes, groups: Mapping[str, Mapping[str, Sequence[float]]], unit: str) -> None:
    """Draw means with standard deviations, side by side.

    Args:
        axis: The axis to draw on.
        groups: Group -> series -> one value per seed [unit].
        unit: Unit of the values.
    """
    series = list(dict.fromkeys(name for group in groups.values() for name in group))
    width = 0.8 / len(series)
    for index, name in enumerate(series):
        values = [group.get(name, (np.nan,)) for group in groups.values()]
        places = np.arange(len(groups)) + (index - (len(series) - 1) / 2) * width
        means, spreads = [np.mean(v) for v in values], [np.std(v) for v in values]
        axis.bar(places, means, width, yerr=spreads, capsize=2, label=name)
    axis.set_xticks(range(len(groups)), list(groups), fontsize=8)
    axis.set_ylabel(f"[{unit}]")
    axis.legend(fontsize=8)
    axis.grid(axis="y", color="0.93")


def score_over_time(
    axis: Axes,
    time: np.ndarray,
    scores: Mapping[str, np.ndarray],
    threshold: float | None = None,
    spans: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Draw anomaly scores over time on a logarithmic axis.

    Args:
        axis: The axis to draw on.
        time: [s], shape (n,).
        scores: Label -> Mahalanobis distance, shape (n,).
        threshold: Highest score that counts as normal.
        spans: Label of an event -> its begin and end [s].
    """
    for index, (label, span) in enumerate((spans or {}).items()):
        axis.axvspan(*span, color=f"C{index + 5}", alpha=0.15, label=label)
    for label, score in scores.items():
        axis.semilogy(time, score, linewidth=1, label=label)
    if threshold is not None:
        axis.axhline(threshold, color="tab:red", linestyle="--", linewidth=1, label="threshold")
    axis.set_xlabel("time [s]")
    axis.set_ylabel("anomaly score")
    axis.legend(fontsize=8)
