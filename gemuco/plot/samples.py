"""Pictures of samples: their estimates with the expected error, and their distance from the normal."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from gemuco.anomaly.score import score
from gemuco.errors import WrongSize
from gemuco.estimation import estimate as estimates
from gemuco.plot.canvas import BLUE, GREY, RED, axes_of
from gemuco.schema import BodySchema, check_schema

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_LINES = 6
"""At most this number of elements is drawn."""
Rows = Mapping[str, np.ndarray]
"""Signal -> values [its unit], shape (samples, n); NaN where not measured."""


def estimate(schema: BodySchema, rows: Rows, hide: str | Sequence[str] = (), axes: "Axes | None" = None) -> "Axes":
    """Draw the estimates of what is not measured in successive samples, with two standard deviations to either side.

    Args:
        schema: The body schema.
        rows: Signal -> values [its unit], shape (samples, n); absent signals and NaN elements are not measured.
        hide: Signals to estimate as if they were not measured; their measured values are drawn for comparison.
        axes: Axes to draw into; a new figure if None.

    Raises:
        WrongKind: The first argument is not a body schema.
        UnknownSignal: A name is not in the layout.
        WrongSize: An array does not have its signal's size.
    """
    check_schema(schema)
    hidden = [hide] if isinstance(hide, str) else list(hide)
    for name in hidden:
        schema.layout.slice(name)
    joined = _joined(schema, rows)
    missing = ~np.isfinite(joined)
    for name in hidden:
        missing[:, schema.layout.slice(name)] = True
    masked = np.where(missing, np.nan, joined)
    solution = estimates(schema, {name: masked[:, span] for name, span in schema.layout.slices.items()})
    value, std = (
        np.hstack([getattr(solution[name], part) for name in schema.layout.names]) for part in ("value", "std")
    )
    wanted = np.flatnonzero(missing.any(axis=0))
    if hidden:  # not what is absent besides
        wanted = schema.layout.indices(hidden)
    axes = axes_of(axes, 9.0, 4.5)
    at = np.arange(len(joined))
    for line, index in enumerate(wanted[:MOST_LINES]):
        color = f"C{line}"
        drawn, spread = (np.where(missing[:, index], part[:, index], np.nan) for part in (value, std))
        axes.plot(at, joined[:, index], color=color, linewidth=3, alpha=0.3)
        axes.fill_between(at, drawn - 2.0 * spread, drawn + 2.0 * spread, color=color, alpha=0.2, linewidth=0)
        axes.plot(at, drawn, color=color, linewidth=1.2, label=schema.layout.element(int(index)))
    units = dict.fromkeys(schema.layout.signal(schema.layout.element(int(i)).partition(".")[0]).unit for i in wanted)
    more = f", {MOST_LINES} of {len(wanted)} elements" if len(wanted) > MOST_LINES else ""
    note = "line: estimate with two standard deviations; pale: measured" if len(wanted) else "everything is measured"
    axes.set_title(f"{note}{more}", loc="left", fontsize=9)
    axes.set_ylabel(f"[{', '.join(units)}]")
    axes.set_xlabel("sample")
    if len(wanted):
        axes.legend(fontsize=8)
    axes.grid(color="0.93")
    return axes


def anomaly(schema: BodySchema, rows: Rows, axes: "Axes | None" = None) -> "Axes":
    """Draw the distance of successive samples from the normal, and the threshold; anomalies are red.

    Args:
        schema: A schema with statistics of prediction errors.
        rows: Signal -> values [its unit], shape (samples, n); absent signals and NaN elements are not measured.
        axes: Axes to draw into; a new figure if None.

    Raises:
        WrongKind: The first argument is not a body schema.
        WrongSize: An array does not have its signal's size.
    """
    check_schema(schema)
    joined = _joined(schema, rows)
    slices = schema.layout.slices.items()
    judged = [score(schema, {name: row[span] for name, span in slices}, blame=False) for row in joined]
    distances, limits = (np.array([getattr(one, part) for one in judged]) for part in ("score", "threshold"))
    is_anomaly = np.array([one.is_anomaly for one in judged], bool)
    axes = axes_of(axes, 9.0, 3.5)
    at = np.arange(len(joined))
    axes.plot(at, distances, color=BLUE, linewidth=1, label="distance from the normal")
    axes.plot(at[is_anomaly], distances[is_anomaly], ".", color=RED, markersize=4, label=_most(judged, is_anomaly))
    axes.plot(at, limits, color=GREY, linestyle="--", linewidth=1.2, label="threshold")
    if np.isfinite(distances).any():
        axes.set_yscale("log")
    axes.set_ylabel("Mahalanobis distance")
    axes.set_xlabel("sample")
    axes.set_title(f"{int(is_anomaly.sum())} of {len(joined)} samples above the threshold", loc="left", fontsize=9)
    axes.legend(fontsize=8)
    axes.grid(color="0.93")
    return axes


def _most(judged: Sequence[object], is_anomaly: np.ndarray) -> str:
    """Return the label of the anomalies, with the element that contributes most to most of them."""
    blamed = [str(getattr(one, "blamed", "")) for one, wrong in zip(judged, is_anomaly, strict=True) if wrong]
    return f"anomaly, most of it in {max(set(blamed), key=blamed.count)}" if blamed else "anomaly"


def _joined(schema: BodySchema, rows: Rows) -> np.ndarray:
    joined = schema.layout.join(rows)
    if joined.ndim != 2:
        raise WrongSize("A picture needs several samples: arrays of shape (samples, n), not of one sample.")
    return np.where(np.isfinite(joined), joined, np.nan)
