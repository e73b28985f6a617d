"""Scores of many samples, and of a window by what windows of a healthy body reach (paper, II-K)."""

from typing import NamedTuple

import numpy as np

from gemuco.anomaly.neighbours import nearness
from gemuco.anomaly.prediction import Judgement, all_errors, judgements, with_bias
from gemuco.schema import BodySchema


class Group(NamedTuple):
    """Samples that lack the same elements.

    Attributes:
        place: Indices of the samples, shape (n,).
        by: Their judgement.
        errors: Their errors, shape (n, errors).
        distances: Their scores, shape (n,).
    """

    place: np.ndarray
    by: Judgement
    errors: np.ndarray
    distances: np.ndarray


def groups(schema: BodySchema, rows: np.ndarray) -> list[Group]:
    """Judge samples [standard deviations], shape (n, size), and return them by the elements that they lack."""
    finite = np.isfinite(rows)
    judged_groups: list[Group] = []
    for pattern in np.unique(finite, axis=0):
        place = np.flatnonzero((finite == pattern).all(axis=1))
        by = schema.derived(judgements)(pattern)
        judged, same = by.judged, with_bias(schema, rows[place])
        errors = all_errors(schema, judged.reading, same, len(judged.mean))
        away = errors[:, judged.place] - judged.mean[judged.place]
        distances = np.sqrt(np.einsum("ij,jk,ik->i", away, judged.precision, away).clip(min=0.0))
        if judged.scale.weight:
            near = nearness(judged.near, same)
            distances = judged.scale.distance(judged.scale.deviations(distances, near))
        judged_groups.append(Group(place, by, errors, distances))
    return judged_groups


def scores(schema: BodySchema, rows: np.ndarray) -> np.ndarray:
    """Return the scores of samples [standard deviations], shape (n, size) -> (n,); NaN where no error is judged."""
    result = np.full(len(rows), np.nan)
    for group in groups(schema, rows):
        if len(group.by.judged.place):
            result[group.place] = group.distances
    return result


def window_score(schema: BodySchema, rows: np.ndarray) -> float:
    """Return how far a window of samples is from normal, as a share of what a window of a healthy body reaches.

    Two means over the window are compared, and the larger share counts: that of the deviations of the samples, and the
    mean error, which a small and lasting shift changes first. Both are measured in standard deviations of such means,
    and given as the share of the distance of a single sample that is as unusual.

    Args:
        schema: A schema with statistics of prediction errors.
        rows: Consecutive samples [standard deviations], oldest first, shape (n, size), about as far apart in time as
            those that the normal errors were learned from.
    """
    normal = schema.normal
    if normal is None or not len(rows):
        return float("nan")
    if normal.windows is not None:
        rows = rows[-normal.windows.longest :]
    judged = [window for window in groups(schema, rows) if len(window.by.judged.place)]
    if not judged:
        return float("nan")
    distances = np.full(len(rows), np.nan)
    thresholds, deviations = distances.copy(), distances.copy()
    for window in judged:
        distances[window.place], thresholds[window.place] = window.distances, window.by.threshold
        deviations[window.place] = (np.log(np.maximum(window.distances, 1e-9)) - window.by.judged.scale[0]) / max(
            window.by.judged.scale[1], 1e-9
        )
    known = np.isfinite(distances)
    if normal.windows is None or normal.scale is None:
        return float(np.sqrt(np.mean((distances[known] / thresholds[known]) ** 2)))
    place = normal.windows.place(int(known.sum()), rows[known])
    share = float(np.exp(normal.scale.std * normal.windows.excess(deviations[known], place)))
    if len(judged) == 1 and judged[0].by.is_complete:
        index, errors = judged[0].by.judged.place, judged[0].errors
        away = (errors[:, index] - normal.mean[index]) / np.sqrt(np.diag(normal.covariance)[index])
        share = max(share, float(np.exp(normal.scale.std * normal.windows.shifted(away, place))))
    return share
