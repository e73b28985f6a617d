"""The distance of a sample from its nearest known samples, as a share of their own distances from each other.

Where a body repeats few motions, a sample beside all of them is odd even if every relation between its elements holds.
"""

import numpy as np

from gemuco.compiled.score import NEIGHBOURS, Near

MOST = 500
"""At most this number of known samples is kept."""


def neighbourhood(cloud: np.ndarray, elements: np.ndarray) -> Near:
    """Prepare known samples [standard deviations], shape (n, size), for the distance by some elements."""
    points = np.ascontiguousarray(cloud[:, elements], float)
    squared = _squared(points, points)
    np.fill_diagonal(squared, np.inf)
    nearest = np.sort(squared, axis=1)[:, :NEIGHBOURS]
    return Near(points, np.sqrt(nearest).mean(axis=1), np.asarray(elements))


def nearness(near: Near, rows: np.ndarray) -> np.ndarray:
    """Return the distance of samples from their neighbours, shape (n, size) -> (n,); see `compiled.score.nearness`."""
    squared = _squared(rows[:, near.elements], near.cloud)
    place = np.argpartition(squared, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
    away = np.sqrt(np.take_along_axis(squared, place, axis=1)).sum(axis=1)
    return np.asarray(away / np.maximum(near.own[place].sum(axis=1), 1e-12))


def _squared(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    squared = (left**2).sum(axis=1)[:, None] + (right**2).sum(axis=1) - 2.0 * left @ right.T
    return np.asarray(squared.clip(min=0.0))
