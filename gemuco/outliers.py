"""Which measured signals cannot be true: the model, which does not see them, misses them by far.

A value is not judged by how rare it is, but by whether the other signals of the same sample bear it out. A rare posture
that was really taken is borne out by them; a glitch of one sensor is not.
"""

import numpy as np

from gemuco.kernels import Weights, run
from gemuco.task import Task

LEAST = 3.0
"""A miss below this many standard deviations of the signal is no outlier: where a model is very good on most of its
data, its misses on rare postures are many times as large and honest all the same."""

LEAST_FAR = 0.2
"""The same in a sample of which an element lies far outside of what is usual. That alone is no fault: it counts against
the sample only if the sample is also missed."""

JUDGES = 3
"""By how many masks a signal is judged, the largest of those that do not contain it."""


def find(
    task: Task,
    weights: Weights,
    rows: np.ndarray,
    bias: np.ndarray,
    limit: float,
    far: np.ndarray,
    known: np.ndarray,
) -> np.ndarray:
    """Signals of samples that are taken for outliers, shape (samples, signals).

    At most one signal per sample is newly suspected, or all that are far out: one wild signal makes the predictions
    of the others wild too. What was suspected before is cleared once the rest of its sample bears it out; so this is
    to be called again, with what it returned, while the model learns.

    Args:
        task: Masks and signals.
        weights: W.
        rows: Samples [standard deviations], shape (samples, layout.size), NaN where nothing was measured.
        bias: p of every sample, shape (samples, bias_size).
        limit: In robust standard deviations of the model's misses.
        far: Which signals are far outside of what is usual, shape (samples, signals).
        known: What is suspected already, shape (samples, signals).
    """
    if not np.isfinite(limit) or not len(rows):
        return known
    measured = np.isfinite(rows)
    least = np.where(far.any(axis=1), LEAST_FAR, LEAST)
    miss = _misses(task, weights, rows, bias, (limit, least), measured & ~known[:, task.signal_of])
    judged = ~np.isnan(miss)
    wild = judged & (np.nan_to_num(miss) > 1.0)
    extreme = wild & far
    worst = np.zeros_like(wild)
    worst[np.arange(len(rows)), np.where(wild, miss, -1.0).argmax(axis=1)] = True
    fresh = np.where(extreme.any(axis=1, keepdims=True), extreme, wild & worst)
    return (known & ~(judged & ~wild)) | fresh


def _misses(
    task: Task,
    weights: Weights,
    rows: np.ndarray,
    bias: np.ndarray,
    tolerated: tuple[float, np.ndarray],
    present: np.ndarray,
) -> np.ndarray:
    """Largest miss of every signal's elements in units of what is tolerated, shape (samples, signals); NaN unjudged.

    Tolerated are so many robust standard deviations, and at least so much in every sample. Of several judges the
    mildest counts.
    """
    limit, least = tolerated
    found = np.full((len(rows), len(task.layout.names)), np.nan)
    allowed = task.allowed(present)
    truth = rows[:, task.out_index]
    judges = {name: _judges(task, name) for name in task.x_out}
    for chosen in sorted({m for several in judges.values() for m in several}):
        there = np.flatnonzero(allowed[:, chosen])
        if not len(there):
            continue
        miss = np.abs(run(weights.whole, task.inputs(rows[there], chosen, bias[there])) - truth[there])
        with np.errstate(invalid="ignore"):
            usual = 1.4826 * np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0 for c in miss.T])
        share = miss / np.maximum(limit * usual, least[there, None])
        share = _by_signal(task, np.nan_to_num(share, nan=-1.0), task.out_index)
        share[share < 0.0] = np.nan
        for name, several in judges.items():
            if chosen in several:
                column = task.layout.names.index(name)
                found[there, column] = np.fmin(found[there, column], share[:, column])
    return found


def _judges(task: Task, name: str) -> list[int]:
    """Indices of the masks that judge a signal: without it if any is, since a signal explains itself."""
    blind = [index for index, m in enumerate(task.masks) if name not in m]
    return sorted(blind or range(len(task.masks)), key=lambda index: -len(task.masks[index]))[:JUDGES]


def _by_signal(task: Task, values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Largest value over the elements of each signal, shape (samples, signals); -1 for signals without any."""
    found = np.full((len(values), len(task.layout.names)), -1.0)
    owners = task.signal_of[index]
    for signal in np.unique(owners):
        found[:, signal] = values[:, owners == signal].max(axis=1)
    return found
