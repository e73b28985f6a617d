"""Map of the parametric bias: p of every trained condition, p now, and its past."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

WIDTH, HEIGHT = 372, 262
EDGE = 26
"""The map has this margin [px] around the outermost point."""
LABEL = 11
"""Labels have this height [px]."""


@dataclass(frozen=True, slots=True)
class BiasMap:
    """Points in the plane.

    Attributes:
        conditions: Name -> point, shape (2,).
        path: Past and present p, oldest first, shape (k, 2).
        axes: Names of the axes.
        nearest: Condition whose p is nearest to the present p, in all dimensions; empty without a present p.
        distance: Distance of p from that condition, as a share of the conditions' mean distance from their mean.
    """

    conditions: Mapping[str, np.ndarray]
    path: np.ndarray
    axes: tuple[str, str]
    nearest: str
    distance: float


def project(biases: Mapping[str, Sequence[float]], path: np.ndarray) -> BiasMap | None:
    """Return the conditions and the path of p, shape (k, size), in the plane; None if the model has no p.

    More than two dimensions are projected on the two in which the conditions differ most.
    """
    points = np.array([np.asarray(bias, float) for bias in biases.values()])
    if points.ndim != 2 or points.shape[1] == 0:
        return None
    size = points.shape[1]
    path = path.reshape(-1, size) if path.size and path.shape[-1] == size else np.zeros((0, size))
    nearest, distance = "", np.nan
    if len(path):
        distances = np.linalg.norm(points - path[-1], axis=1)
        spread = float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean()) or 1.0
        nearest, distance = list(biases)[int(np.argmin(distances))], float(distances.min()) / spread
    if size == 1:
        plane, axes = np.array([[1.0, 0.0]]), ("p", "")
        origin = np.zeros(1)
    elif size == 2:
        plane, axes, origin = np.eye(2), ("p1", "p2"), np.zeros(2)
    else:
        origin = points.mean(axis=0)
        _, spread_by, directions = np.linalg.svd(points - origin, full_matrices=False)
        plane = np.zeros((size, 2))
        plane[:, : min(2, len(directions))] = directions[:2].T
        share = spread_by**2 / max(float((spread_by**2).sum()), 1e-12)
        first, second = (float(share[index]) if index < len(share) else 0.0 for index in (0, 1))
        axes = (f"principal axis 1 of {size}, {first:.0%}", f"axis 2, {second:.0%}")
    placed = dict(zip(biases, (points - origin) @ plane, strict=True))
    return BiasMap(placed, (path - origin) @ plane, axes, nearest, distance)


class BiasPicture:
    """Picture of the map, which keeps its range, so that no point jumps when p leaves it."""

    def __init__(self) -> None:
        self._frame: tuple[np.ndarray, np.ndarray] | None = None
        self._names: tuple[str, ...] = ()

    def svg(self, bias_map: BiasMap, is_old: bool) -> str:
        """Return the picture as SVG; `is_old` draws it pale."""
        low, high = self._box(bias_map)

        def place(point: np.ndarray) -> tuple[float, float]:
            share = (point - low) / (high - low)
            return EDGE + share[0] * (WIDTH - 2 * EDGE), HEIGHT - EDGE - share[1] * (HEIGHT - 2 * EDGE)

        parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" class="gm-map{" gm-old" if is_old else ""}" role="img">']
        parts.append(f'<rect x="0.5" y="0.5" width="{WIDTH - 1}" height="{HEIGHT - 1}" rx="4" class="frame"/>')
        parts.append(
            f'<text x="{WIDTH - 8}" y="{HEIGHT - 8}" text-anchor="end" class="axis">{bias_map.axes[0]} →</text>'
        )
        if bias_map.axes[1]:
            parts.append(f'<text x="8" y="16" class="axis">{bias_map.axes[1]} ↑</text>')
        parts += self._points(bias_map, place)
        if len(bias_map.path):
            places = [place(point) for point in bias_map.path]
            line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
            x, y = places[-1]
            parts.append(f'<polyline points="{line}" class="way"/>')
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="6.5" class="now"/>')
            parts.append(f'<path d="M{x - 10:.1f} {y:.1f}h20M{x:.1f} {y - 10:.1f}v20" class="now"/>')
        return "".join(parts) + "</svg>"

    def _points(self, bias_map: BiasMap, place: Callable[[np.ndarray], tuple[float, float]]) -> list[str]:
        parts: list[str] = []
        taken: list[tuple[float, float]] = []
        for name, point in bias_map.conditions.items():
            x, y = place(point)
            chosen = " near" if name == bias_map.nearest else ""
            parts.append(f'<rect x="{x - 3.5:.1f}" y="{y - 3.5:.1f}" width="7" height="7" class="condition{chosen}"/>')
            at = y + 4
            while any(abs(at - other) < LABEL and abs(x - where) < 90 for where, other in taken):
                at += LABEL
            at = min(at, HEIGHT - 4.0)
            taken.append((x, at))
            anchor, beside = ("end", x - 8) if x > WIDTH - 100 else ("start", x + 8)
            text = f'<text x="{beside:.1f}" y="{at:.1f}" text-anchor="{anchor}" class="label{chosen}">'
            parts.append(f"{text}{escape(name)}</text>")
        return parts

    def _box(self, bias_map: BiasMap) -> tuple[np.ndarray, np.ndarray]:
        points = np.array([*bias_map.conditions.values(), *bias_map.path])
        low, high = points.min(axis=0), points.max(axis=0)
        if self._names != tuple(bias_map.conditions):
            self._frame, self._names = None, tuple(bias_map.conditions)
        if self._frame is not None:
            low, high = np.minimum(low, self._frame[0]), np.maximum(high, self._frame[1])
        flat = high - low < 1e-9
        low, high = np.where(flat, low - 0.5, low), np.where(flat, high + 0.5, high)
        self._frame = (low, high)
        return low, high
