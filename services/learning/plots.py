"""Pictures of structure determination and of a training, and the PNG file that every picture is drawn into."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from gemuco.learning.history import History
from gemuco.structure.determination import Structure

DPI = 110
GOOD, BAD = "tab:green", "0.6"


@contextmanager
def picture(path: Path, title: str = "", rows: int = 1, columns: int = 1, **options: Any) -> Iterator[list[Axes]]:
    """Yield axes to draw on, row by row; write the PNG when the block ends. Options are those of `plt.subplots`."""
    figure, grid = plt.subplots(rows, columns, layout="constrained", squeeze=False, **options)
    try:
        if title:
            figure.suptitle(title)
        yield list(grid.flat)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=DPI)
    finally:
        plt.close(figure)


def plot_history(history: History, title: str, path: Path) -> None:
    """Draw the learning curve into a PNG."""
    with picture(path, figsize=(8, 4.5)) as (axis,):
        axis.semilogy(history.train, color="tab:blue", label="training data")
        axis.semilogy(history.held_out, color="tab:orange", label="held-out data")
        axis.axvline(
            history.best_epoch, color="0.6", linestyle=":", label=f"best epoch: {history.best:.4g} on held-out data"
        )
        if history.resumed:
            axis.axvline(history.resumed, color="0.8", label="continued after an interruption")
        axis.set_title(title)
        axis.set_xlabel("epoch")
        axis.set_ylabel("loss [standard deviations squared]")
        axis.legend()


def plot_structure(structure: Structure, path: Path) -> None:
    """Draw L_i and L_m against their thresholds into a PNG."""
    masks = list(structure.listed)
    heights = [len(structure.L_i) + 2, len(masks) + 2]
    with picture(path, rows=2, figsize=(10, 1.6 + 0.27 * sum(heights)), height_ratios=heights) as (upper, lower):
        _outputs(upper, structure, "L_i: each signal inferred from all others; an output if below the line")
        _masks(lower, structure, masks)


def _outputs(axis: Axes, structure: Structure, title: str) -> None:
    names = list(structure.L_i)
    _bars(
        axis, names, [structure.L_i[n] for n in names], [n in structure.x_out for n in names], structure.thresholds.out
    )
    axis.set_title(title, loc="left", fontsize=10)


def _masks(axis: Axes, structure: Structure, masks: list[frozenset[str]]) -> None:
    """Draw one row per mask: a square per signal it contains, and its error."""
    names, feasible = structure.layout.names, set(structure.feasible)
    rows = ["".join("■" if n in m else "□" for n in names) for m in masks]
    errors = [structure.L_m[m] for m in masks]
    _bars(axis, rows, errors, [m in feasible for m in masks], structure.thresholds.into)
    known = len(structure.L_m)
    shown = f"the best {len(masks)} of {known} masks" if len(masks) < known else f"{known} masks"
    axis.set_title(f"L_m: outputs inferred from a mask; feasible if below the line; {shown}", loc="left", fontsize=10)
    axis.set_xlabel(f"{structure.thresholds.measure} in standard deviations; squares: {', '.join(names)}", fontsize=8)


def _bars(axis: Axes, labels: list[str], values: list[float], good: list[bool], threshold: float) -> None:
    """Draw bars with their values."""
    places = np.arange(len(labels))
    axis.barh(places, values, color=[GOOD if g else BAD for g in good])
    for place, value in zip(places, values, strict=True):
        axis.annotate(f" {value:.3f}", (value, place), va="center", fontsize=8)
    axis.axvline(threshold, color="tab:red", linestyle="--", linewidth=1)
    axis.set_yticks(places, labels, fontsize=9)
    axis.invert_yaxis()
    axis.set_xlim(0.0, 1.15 * max(threshold, *values))
    axis.spines[["top", "right"]].set_visible(False)
