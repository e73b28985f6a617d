"""Which measured signals cannot be true: the model, which does not see them, misses them by far.

A value is not judged by how rare it is, but by whether the other signals of the same sample bear it out. A rare posture
that was really taken is borne out by them; a glitch of one sensor is not.
"""

import numpy as np

from gemuco.layers import Weights, run
from gemuco.learning.material import Material
from gemuco.learning.task import Task

LEAST = 3.0
"""A miss below this many standard deviations of the signal is no outlier: where a model is very good on most of its
data, its misses on rare postures are many times as large and honest all the same."""

LEAST_FAR = 0.2
"""The same in a sample of which an element lies far outside of what is usual. That alone is no fault: it counts against
the sample only if the sample is also missed."""

JUDGES = 3
"""By how many masks a signal is judged, the largest of those that do not contain it."""


def find(material: Material, weights: Weights, bias: np.ndarray, limit: float) -> np.ndarray:
    """Signals of samples that are taken for outliers, shape (samples, signals).

    At most one signal per sample is newly suspected, or all that are far out: one wild signal makes the predictions
    of the others wild too. What the material hides as suspected is cleared once the rest of its sample bears it out;
    so this is to be called again while the model learns.

    Args:
        material: The samples.
        weights: W.
        bias: p of every sample, shape (samples, bias_size).
        limit: In robust standard deviations of the model's misses.
    """
    known, far = material.suspected, material.far
    if not np.isfinite(limit) or not len(known):
        return known
    miss = _misses(material, weights, bias, limit)
    judged = ~np.isnan(miss)
    wild = judged & (np.nan_to_num(miss) > 1.0)
    extreme = wild & far
    worst = np.zeros_like(wild)
    worst[np.arange(len(known)), np.where(wild, miss, -1.0).argmax(axis=1)] = True
    fresh = np.where(extreme.any(axis=1, keepdims=True), extreme, wild & worst)
    return (known & ~(judged & ~wild)) | fresh


def _misses(material: Material, weights: Weights, bias: np.ndarray, limit: float) -> np.ndarray:
    """Largest miss of every signal's elements in units of what is tolerated, shape (samples, signals); NaN unjudged.

    Tolerated are so many robust standard deviations, and at least `LEAST`. Of several judges the mildest counts.
    """
    task, known = material.task, material.suspected
    least = np.where(material.far.any(axis=1), LEAST_FAR, LEAST)
    found = np.full(known.shape, np.nan)
    for name in task.x_out:
        column = task.layout.names.index(name)
        hidden = known.copy()
        hidden[:, column] = False  # else what only masks with it can judge would stay suspected for ever
        allowed = task.allowed(material.granted & ~hidden[:, task.signal_of])
        out = task.out_index[task.signal_of[task.out_index] == column]
        columns = np.flatnonzero(np.isin(task.out_index, out))
        for chosen in _judges(task, name):
            there = np.flatnonzero(allowed[:, chosen])
            told = run(weights.whole, task.inputs(material.rows[there], chosen, bias[there]))[:, columns]
            miss = np.abs(told - material.rows[there][:, out])
            usual = [np.median(part[np.isfinite(part)]) if np.isfinite(part).any() else 0.0 for part in miss.T]
            share = miss / np.maximum(limit * 1.4826 * np.array(usual), least[there, None])
            found[there, column] = np.fmin(found[there, column], _largest(share))
    return found


def _largest(share: np.ndarray) -> np.ndarray:
    """Over the elements that were measured, shape (samples,); NaN where none was."""
    filled = np.where(np.isfinite(share), share, -1.0).max(axis=1)
    return np.where(filled >= 0.0, filled, np.nan)


def _judges(task: Task, name: str) -> list[int]:
    """Indices of the masks that judge a signal: without it if any is, since a signal explains itself."""
    blind = [index for index, m in enumerate(task.masks) if name not in m]
    return sorted(blind or range(len(task.masks)), key=lambda index: -len(task.masks[index]))[:JUDGES]
