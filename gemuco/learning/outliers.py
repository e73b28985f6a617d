"""Detection of outliers: measured signals that differ much from what the model predicts from the other signals.

A value is not an outlier because it is rare. In a rare posture all signals agree with each other; in a sensor glitch
one signal disagrees with the others.
"""

import numpy as np

from gemuco.layers import Weights, run
from gemuco.learning.material import Material
from gemuco.learning.task import Task

LEAST = 3.0
"""An error below this many standard deviations of the signal is no outlier: where a model is very good on most of its
data, its errors on rare postures are many times as large although the data are right."""

LEAST_FAR = 0.2
"""This replaces `LEAST` in a sample with an element far outside its usual range. Such an element alone is no outlier:
the prediction must also be wrong."""

JUDGES = 3
"""A signal is judged by at most this many masks, the largest of those that do not contain it."""


def find(material: Material, weights: Weights, bias: np.ndarray, limit: float) -> np.ndarray:
    """Return the signals of samples that are outliers, truth values, shape (samples, signals).

    At most one signal per sample is newly suspected, or all that are far out, because one wrong signal makes the
    predictions of the others wrong too. A suspected signal is cleared when the rest of its sample agrees with it, so
    the search is repeated while the model learns.

    Args:
        material: The samples.
        weights: W.
        bias: p of every sample, shape (samples, bias_size).
        limit: Tolerated error, in robust standard deviations of the model's errors.
    """
    known, far = material.suspected, material.far
    if not np.isfinite(limit) or not len(known):
        return known
    error = _errors(material, weights, bias, limit)
    judged = ~np.isnan(error)
    wild = judged & (np.nan_to_num(error) > 1.0)
    extreme = wild & far
    worst = np.zeros_like(wild)
    worst[np.arange(len(known)), np.where(wild, error, -1.0).argmax(axis=1)] = True
    fresh = np.where(extreme.any(axis=1, keepdims=True), extreme, wild & worst)
    return (known & ~(judged & ~wild)) | fresh


def _errors(material: Material, weights: Weights, bias: np.ndarray, limit: float) -> np.ndarray:
    """Return the largest error of each signal's elements as a share of the tolerated one, shape (samples, signals).

    Tolerated are `limit` robust standard deviations, and at least `LEAST`. The smallest share of several judging masks
    counts. A signal that no mask can judge is NaN.
    """
    task, known = material.task, material.suspected
    least = np.where(material.far.any(axis=1), LEAST_FAR, LEAST)
    shares = np.full(known.shape, np.nan)
    for name in task.x_out:
        column = task.layout.names.index(name)
        hidden = known.copy()
        hidden[:, column] = False  # else a signal that only masks containing it can judge would stay suspected
        allowed = task.allowed(material.granted & ~hidden[:, task.signal_of])
        out = task.out_index[task.signal_of[task.out_index] == column]
        columns = np.flatnonzero(np.isin(task.out_index, out))
        for judge in _judges(task, name):
            samples = np.flatnonzero(allowed[:, judge])
            prediction = run(weights.whole, task.inputs(material.rows[samples], judge, bias[samples]))[:, columns]
            error = np.abs(prediction - material.rows[samples][:, out])
            usual = [np.median(part[np.isfinite(part)]) if np.isfinite(part).any() else 0.0 for part in error.T]
            share = error / np.maximum(limit * 1.4826 * np.array(usual), least[samples, None])
            shares[samples, column] = np.fmin(shares[samples, column], _largest(share))
    return shares


def _largest(share: np.ndarray) -> np.ndarray:
    """Return the largest share over the measured elements, shape (samples,); NaN without a measured element."""
    filled = np.where(np.isfinite(share), share, -1.0).max(axis=1)
    return np.where(filled >= 0.0, filled, np.nan)


def _judges(task: Task, name: str) -> list[int]:
    """Return the indices of the masks that judge a signal: masks without it, if there are any."""
    blind = [index for index, m in enumerate(task.masks) if name not in m]
    return sorted(blind or range(len(task.masks)), key=lambda index: -len(task.masks[index]))[:JUDGES]
