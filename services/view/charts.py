"""Curves of the last 30 s as SVG: missing values stay gaps, and the axes move only when necessary."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from gemuco.certainty.certainty import NINETY
from services.view.trail import WINDOW

COLORS = (
    "#7cc0ff", "#63d297", "#ff8f8f", "#c792ea", "#5fd7d7", "#f5e07a", "#b8a1ff", "#8fd46a", "#ff9ecb", "#a9b4c2",
)  # fmt: skip
WIDTH = 376
LEFT, RIGHT, TOP, BOTTOM = 46, 8, 6, 18
"""The curves have these margins [px]."""
SECONDS = (-30, -20, -10, 0)
ROOMY = 3.0
"""The axis shrinks only if its range is more than this factor larger than that of the values."""


@dataclass(frozen=True, slots=True)
class Line:
    """One curve.

    Attributes:
        name: Name in the legend.
        values: Values with NaN in gaps, shape (k,).
        color: Color of the curve.
        dashed: Whether it is dashed.
        half: Half the height of a band around the values, shape (k,); without it no band is drawn.
    """

    name: str
    values: np.ndarray
    color: str
    dashed: bool = False
    half: np.ndarray | None = None


class Chart:
    """Picture of curves against time, which keeps its axis.

    Args:
        height: Height of the picture [px].
    """

    def __init__(self, height: int) -> None:
        self._height = height
        self._range: tuple[float, float] | None = None
        self._key = ""

    def svg(self, time: np.ndarray, lines: Sequence[Line], unit: str, key: str, at: str = "") -> str:
        """Return the picture as SVG.

        Args:
            time: Time relative to now [s], shape (k,).
            lines: Curves.
            unit: Unit of all curves.
            key: Name of the picture; a new name gets a new axis.
            at: Clock time of the right end if it is not now.
        """
        low, high = self._axis(lines, key)
        parts = [f'<svg viewBox="0 0 {WIDTH} {self._height}" class="gm-map" role="img">']
        parts.append(f'<rect x="0.5" y="0.5" width="{WIDTH - 1}" height="{self._height - 1}" rx="4" class="frame"/>')
        bottom = self._height - BOTTOM
        for tick in ticks(low, high):
            y = self._y(tick, low, high)
            parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" class="grid"/>')
            parts.append(f'<text x="{LEFT - 4}" y="{y + 3.5:.1f}" text-anchor="end" class="axis">{tick:.6g}</text>')
        for second in SECONDS:
            x = self._x(np.array([float(second)]))[0]
            parts.append(f'<path d="M{x:.1f} {TOP}V{bottom}" class="grid"/>')
            label = (at or "now") if second == 0 else f"{second} s"
            anchor = "end" if second == 0 else "middle"
            parts.append(f'<text x="{x:.1f}" y="{self._height - 5}" text-anchor="{anchor}" class="axis">{label}</text>')
        parts.append(f'<text x="{LEFT + 4}" y="{TOP + 10}" class="axis">{escape(unit)}</text>')
        xs = self._x(time)
        parts += [self._band(xs, line, low, high) for line in lines if line.half is not None]
        parts += [self._curve(xs, line, low, high) for line in lines]
        return "".join(parts) + "</svg>"

    def _x(self, time: np.ndarray) -> np.ndarray:
        return LEFT + (time + WINDOW) / WINDOW * (WIDTH - LEFT - RIGHT)

    def _y(self, value: float, low: float, high: float) -> float:
        return TOP + (high - value) / (high - low) * (self._height - TOP - BOTTOM)

    def _band(self, xs: np.ndarray, line: Line, low: float, high: float) -> str:
        """Return the band around a curve, cut at the frame."""
        assert line.half is not None
        is_drawn = np.isfinite(line.values) & np.isfinite(line.half) & (xs >= LEFT)
        shapes = []
        for run in np.split(np.arange(len(xs)), np.flatnonzero(np.diff(is_drawn)) + 1):
            if not len(run) or not is_drawn[run[0]]:
                continue
            upper = [(xs[k], min(line.values[k] + line.half[k], high)) for k in run]
            lower = [(xs[k], max(line.values[k] - line.half[k], low)) for k in run[::-1]]
            corners = " ".join(f"{x:.0f},{self._y(value, low, high):.1f}" for x, value in (*upper, *lower))
            shapes.append(f'<polygon points="{corners}" fill="{line.color}" fill-opacity="0.2"/>')
        return "".join(shapes)

    def _curve(self, xs: np.ndarray, line: Line, low: float, high: float) -> str:
        path, pen_down = [], False
        for x, value in zip(xs, line.values, strict=True):
            if not math.isfinite(value) or x < LEFT:
                pen_down = False
                continue
            path.append(f"{'L' if pen_down else 'M'}{x:.0f} {self._y(value, low, high):.1f}")
            pen_down = True
        look = ' stroke-width="2.2" stroke-dasharray="5 3"' if line.dashed else ' stroke-width="1.4"'
        return f'<path d="{"".join(path)}" fill="none" stroke="{line.color}"{look}/>'

    def _axis(self, lines: Sequence[Line], key: str) -> tuple[float, float]:
        """Return the lowest and the highest value of the axis."""
        known = np.concatenate([line.values[np.isfinite(line.values)] for line in lines] or [np.zeros(0)])
        if key != self._key:
            self._range, self._key = None, key
        if not known.size:
            return self._range or (0.0, 1.0)
        low, high = float(known.min()), float(known.max())
        shown = self._range
        if shown is None or low < shown[0] or high > shown[1] or shown[1] - shown[0] > ROOMY * max(high - low, 1e-6):
            room = max(0.15 * (high - low), 1e-3 * max(abs(low), abs(high)), 1e-6)
            self._range = shown = (low - room, high + room)
        return shown


def ticks(low: float, high: float) -> list[float]:
    """Return three to six round numbers between two values."""
    rough = (high - low) / 4.0
    size = 10.0 ** math.floor(math.log10(rough))
    step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= rough)
    first = math.ceil(low / step)
    return [round(index * step, 12) for index in range(first, math.floor(high / step) + 1)]


def legend(lines: Sequence[Line]) -> str:
    """Return the names of the solid curves, in their colors."""
    names = (f'<span style="color:{line.color}">━ {escape(line.name)}</span>' for line in lines if not line.dashed)
    return f'<div class="legend">{" ".join(names)} <span class="dim">╍ estimated, with the band of 90 %</span></div>'


def signal_lines(elements: Sequence[str], measured: np.ndarray, estimated: np.ndarray, std: np.ndarray) -> list[Line]:
    """Return the curves of elements from measured and estimated values and std, each of shape (elements, k)."""
    lines: list[Line] = []
    for index, element in enumerate(elements):
        color = COLORS[index % len(COLORS)]
        lines.append(Line(element, measured[index], color))
        own = "#ffb454" if len(elements) == 1 else color
        lines.append(Line(element, estimated[index], own, dashed=True, half=NINETY * std[index]))
    return lines
