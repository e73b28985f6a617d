"""Pictures of a schema: which signals explain which, how well, and the p of its conditions."""

from typing import TYPE_CHECKING, Any

import numpy as np

from gemuco.masks import Mask, label
from gemuco.plot.canvas import BLUE, GREY, RED, axes_of
from gemuco.schema import BodySchema, check_schema

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_ROWS = 24
"""At most this number of masks is drawn: the best ones of every signal, and those of the fewest signals."""
WORST = 100.0
"""An error of this size [% of a standard deviation] is that of guessing the mean, and has the last colour."""
COLOURS = "RdYlGn_r"


def structure(schema: BodySchema, axes: "Axes | None" = None) -> "Axes":
    """Draw which signals explain which: a row per feasible mask, a column per signal.

    A dark square is a given signal. A coloured one is inferred from the given signals of its row; the number is its
    error on held-out data [% of its standard deviation]. An empty one is not inferred.

    Raises:
        WrongKind: The first argument is not a body schema.
    """
    check_schema(schema)
    names, masks = schema.layout.names, listed(schema)
    grid = np.full((len(masks), len(names)), np.nan)
    for row, mask in enumerate(masks):
        for column, name in enumerate(names):
            if name in schema.x_out and name not in mask and ("mask", mask) in schema.errors:
                grid[row, column] = 100.0 * np.sqrt(schema.mask_error(mask, name))
    longest = max(map(len, names))
    axes = axes_of(axes, 1.6 + 0.62 * len(names), 0.9 + 0.07 * longest + 0.3 * len(masks))
    axes.imshow(np.ma.masked_invalid(grid), cmap=COLOURS, vmin=0.0, vmax=WORST, aspect="auto")
    for row, mask in enumerate(masks):
        for column, name in enumerate(names):
            if name in mask:
                axes.add_patch(_square(column, row))
            elif np.isfinite(grid[row, column]):
                axes.text(column, row, f"{grid[row, column]:.0f}", ha="center", va="center", fontsize=8)
    axes.set_xticks(range(len(names)), names, rotation=45, ha="left", rotation_mode="anchor", fontsize=8)
    axes.xaxis.tick_top()
    axes.set_yticks([])
    axes.set_xticks(np.arange(len(names) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(masks) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1.5)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set_visible(False)
    more = f"; {len(masks)} of {len(schema.masks)} masks" if len(masks) < len(schema.masks) else ""
    axes.set_xlabel(f"dark: given; number: error of what is inferred [% of std]{more}", fontsize=8)
    return axes


def _square(column: int, row: int) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, facecolor="0.25", edgecolor="none")


def listed(schema: BodySchema) -> list[Mask]:
    """Return the masks to draw, those of few signals first: the best of every signal, then those of the fewest."""
    chosen: dict[Mask, None] = {}
    for name in schema.x_out:
        own = [mask for mask in schema.ranked(name) if name not in mask]
        chosen.update(dict.fromkeys(own[:1]))
    chosen.update(dict.fromkeys(sorted(schema.masks, key=len)))
    masks = list(chosen)[:MOST_ROWS]
    order = {name: index for index, name in enumerate(schema.layout.names)}
    return sorted(masks, key=lambda mask: (len(mask), sorted(order[name] for name in mask)))


def errors(schema: BodySchema, axes: "Axes | None" = None) -> "Axes":
    """Draw how well each signal is inferred if it is not measured: its error on held-out data from its best mask.

    Raises:
        WrongKind: The first argument is not a body schema.
    """
    check_schema(schema)
    rows: list[tuple[str, float, str]] = []
    for name in schema.x_out:
        masks = [mask for mask in schema.ranked(name) if name not in mask and ("mask", mask) in schema.errors]
        if not masks:
            rows.append((name, np.nan, "only from masks that contain it"))
            continue
        rms = float(np.sqrt(np.mean(schema.out_layout.split(schema.errors["mask", masks[0]])[name] ** 2)))
        text = f"{rms:.3g} {schema.layout.signal(name).unit} from {label(masks[0], schema.layout.names)}"
        rows.append((name, 100.0 * float(np.sqrt(schema.mask_error(masks[0], name))), text.replace("+", " + ")))
    axes = axes_of(axes, 9.0, 0.9 + 0.36 * len(rows))
    lengths = [length if np.isfinite(length) else 0.0 for _, length, _ in rows]
    poor = schema.manifest.get("poor", ())
    axes.barh(range(len(rows)), lengths, color=[RED if name in poor else BLUE for name, _, _ in rows])
    for row, (length, (_, _, text)) in enumerate(zip(lengths, rows, strict=True)):
        axes.annotate(f"  {text}", (length, row), va="center", fontsize=8)
    axes.set_yticks(range(len(rows)), [name for name, _, _ in rows], fontsize=9)
    axes.invert_yaxis()
    axes.set_xlim(0.0, 2.2 * max([*lengths, 1.0]))
    axes.set_xlabel("error on held-out data if not measured [% of the standard deviation]", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def bias_map(schema: BodySchema, axes: "Axes | None" = None) -> "Axes":
    """Draw the p of every trained condition, and the present one; more than two dimensions on their principal axes.

    Raises:
        WrongKind: The first argument is not a body schema.
    """
    check_schema(schema)
    axes = axes_of(axes, 5.0, 4.0)
    size = len(schema.bias)
    if not size:
        axes.text(0.5, 0.5, "This model has no parametric bias p.", ha="center", transform=axes.transAxes, color=GREY)
        axes.set_axis_off()
        return axes
    names = list(schema.biases)
    points = np.array([*schema.biases.values(), schema.bias], float)  # the present p last
    origin, plane = np.zeros(size), np.eye(size, 2)
    labels = ["p1", "p2" if size > 1 else ""]
    if size > 2:
        origin = points.mean(axis=0)
        _, spread, directions = np.linalg.svd(points[:-1] - origin, full_matrices=False)
        plane = np.zeros((size, 2))
        plane[:, : len(directions[:2])] = directions[:2].T
        share = [*(spread**2 / max(float(np.sum(spread**2)), 1e-12)), 0.0, 0.0]
        labels = [f"principal axis {number + 1} of {size} ({share[number]:.0%})" for number in range(2)]
    placed = (points - origin) @ plane
    axes.plot(*placed[:-1].T, "s", color=GREY, markersize=6, label="trained conditions")
    axes.plot(*placed[-1], "+", color=RED, markersize=14, markeredgewidth=2, label="present p")
    for name, (x, y) in zip(names, placed, strict=False):
        axes.annotate(name, (x, y), (6, 4), textcoords="offset points", fontsize=8)
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    axes.margins(0.2)
    axes.grid(color="0.93")
    axes.legend(fontsize=8)
    return axes
