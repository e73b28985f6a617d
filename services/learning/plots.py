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
from gemuco.structure.result import with_unit
from gemuco.writing import replacing

DPI = 110
GOOD, POOR, BAD = "tab:green", "tab:orange", "0.6"


@contextmanager
def picture(path: Path, title: str = "", rows: int = 1, columns: int = 1, **options: Any) -> Iterator[list[Axes]]:
    """Yield axes to draw on, row by row; write the PNG when the block ends. Options are those of `plt.subplots`."""
    figure, grid = plt.subplots(rows, columns, layout="constrained", squeeze=False, **options)
    try:
        if title:
            figure.suptitle(title)
        yield list(grid.flat)
        with replacing(path) as file:
            figure.savefig(file, dpi=DPI, format="png")
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
    """Draw L_i and L_m with their spread against the thresholds into a PNG."""
    masks = list(structure.listed)
    heights = [len(structure.L_i) + 2, len(masks) + 2]
    title = f"Structure, {structure.splits} splits" + (": POOR, above the threshold" if structure.is_poor else "")
    size = (10, 2.0 + 0.27 * sum(heights))
    with picture(path, title, rows=2, figsize=size, height_ratios=heights) as (upper, lower):
        _outputs(upper, structure, "L_i: each signal inferred from its best mask; an output if below the line")
        _masks(lower, structure, masks)


def _outputs(axis: Axes, structure: Structure, title: str) -> None:
    names = list(structure.L_i)
    colours = [POOR if n in structure.poor else GOOD if n in structure.x_out else BAD for n in names]
    spreads = [structure.spread_i.get(n, np.nan) for n in names]
    notes = [f"{structure.L_i[n]:.3f}: {structure.error_text(n)}" for n in names]
    _bars(axis, names, [structure.L_i[n] for n in names], spreads, colours, notes, structure.thresholds.out)
    axis.set_title(title, loc="left", fontsize=10)


def _masks(axis: Axes, structure: Structure, masks: list[frozenset[str]]) -> None:
    """Draw one row per mask: a square per signal it contains, its error, and the errors of the outputs it lacks."""
    layout, feasible = structure.layout, set(structure.feasible)
    rows = ["".join("■" if n in m else "□" for n in layout.names) for m in masks]
    colours = [GOOD if m in feasible else POOR if m in structure.masks else BAD for m in masks]
    notes = []
    for m in masks:
        percent = 100.0 * structure.thresholds.share(structure.L_m[m])
        errors = [with_unit(rms, layout.signal(name).unit) for name, rms in structure.rms_m.get(m, {}).items()]
        notes.append(f"{structure.L_m[m]:.3f}: {percent:.0f} % std" + (f" ({', '.join(errors)})" if errors else ""))
    spreads = [structure.spread_m.get(m, np.nan) for m in masks]
    _bars(axis, rows, [structure.L_m[m] for m in masks], spreads, colours, notes, structure.thresholds.into)
    known = len(structure.L_m)
    shown = f"the best {len(masks)} of {known} masks" if len(masks) < known else f"{known} masks"
    axis.set_title(f"L_m: outputs inferred from a mask; feasible if below the line; {shown}", loc="left", fontsize=10)
    axis.set_xlabel(
        f"{structure.thresholds.measure} in standard deviations, with its standard error; squares: "
        f"{', '.join(layout.names)}",
        fontsize=8,
    )


def _bars(
    axis: Axes,
    labels: list[str],
    values: list[float],
    spreads: list[float],
    colours: list[str],
    notes: list[str],
    threshold: float,
) -> None:
    """Draw bars with their spreads and notes; an infinite value has no bar."""
    places = np.arange(len(labels))
    lengths, margins = (np.where(np.isfinite(part), part, 0.0) for part in (values, spreads))
    axis.barh(places, lengths, xerr=margins, color=colours, error_kw={"ecolor": "0.3", "elinewidth": 1, "capsize": 2})
    for place, end, note in zip(places, lengths + margins, notes, strict=True):
        axis.annotate(f"  {note}", (end, place), va="center", fontsize=8, zorder=3)
    axis.axvline(threshold, color="tab:red", linestyle="--", linewidth=1, zorder=0)
    axis.set_yticks(places, labels, fontsize=9)
    axis.invert_yaxis()
    axis.set_xlim(0.0, 1.5 * max(threshold, *(lengths + margins)))
    axis.spines[["top", "right"]].set_visible(False)
