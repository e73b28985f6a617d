"""Picture of the tables of structure determination."""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from gemuco.structure.determination import Structure

GOOD, BAD = "tab:green", "0.6"


def plot(structure: Structure, path: Path) -> None:
    """Draw L_i and L_m against their thresholds into a PNG."""
    masks = list(structure.listed)
    heights = [len(structure.L_i) + 2, len(masks) + 2]
    figure, (upper, lower) = plt.subplots(
        2, 1, figsize=(10, 1.6 + 0.27 * sum(heights)), height_ratios=heights, layout="constrained"
    )
    upper_title = "L_i: each signal inferred from all others; an output if below the line"
    _outputs(upper, structure, upper_title)
    _masks(lower, structure, masks)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


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
