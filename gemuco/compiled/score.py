"""Anomaly score of one sample (paper, II-K): its prediction errors and their Mahalanobis distance."""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.chain import first, forward, space
from gemuco.compiled.jit import jit


class Judges(NamedTuple):
    """Masks by which the elements of x_out are judged.

    Attributes:
        through: 1 for elements of x_in that a mask lets through, else 0, shape (masks, in_size).
        paths: Regression of the code l under every mask, shape (masks, in_size + 1, width).
        tails: m and p of every mask, shape (masks, x_in + bias_size).
        mask: Index of the mask that judges each element, shape (out_size,).
    """

    through: np.ndarray
    paths: np.ndarray
    tails: np.ndarray
    mask: np.ndarray


@jit
def errors(predictor, judges, joined):
    """Return measured minus predicted [unit], shape (out_size,); NaN where one of them is missing.

    Args:
        predictor: The network.
        judges: Mask of every element.
        joined: Every element of the layout [its unit], shape (size,); NaN where not measured.
    """
    rows, count = judges.through.shape
    values = space(predictor.chain, rows)
    inputs = first(predictor.chain, values, rows)
    complete, width = np.ones(rows, np.bool_), judges.paths.shape[2]
    for row in range(rows):
        for k in range(width):
            inputs[row, count + k] = judges.paths[row, count, k]
        for i in range(count):
            inputs[row, i] = 0.0
            if judges.through[row, i] > 0.0:
                element = predictor.inputs[i]
                x = (joined[element] - predictor.scale[0, element]) / predictor.scale[1, element]
                if np.isfinite(x):
                    inputs[row, i] = min(max(x, -predictor.clip), predictor.clip)
                    for k in range(width):
                        inputs[row, count + k] += x * judges.paths[row, i, k]
                else:
                    complete[row] = False
        for i in range(judges.tails.shape[1]):
            inputs[row, count + width + i] = judges.tails[row, i]
    prediction = forward(predictor.chain, values, rows)
    error = np.full(len(judges.mask), np.nan)
    for i in range(len(judges.mask)):
        element, row = predictor.outputs[i], judges.mask[i]
        if complete[row]:
            error[i] = joined[element] - prediction[row, i] * predictor.scale[1, element] - predictor.scale[0, element]
    return error


@jit
def distance(error, mean, index, precision):
    """Return the Mahalanobis distance of the elements `index` of an error, and their contributions to its square.

    Args:
        error: Measured minus predicted, shape (out_size,).
        mean: Mean error of a healthy body, shape (out_size,).
        index: Indices of the judged elements, shape (n,).
        precision: Inverse covariance of the judged elements, shape (n, n).

    Returns:
        The distance; and by how much its square falls without each element, (P e)_i^2 / P_ii, shape (out_size,), NaN
        for elements that are not judged.
    """
    contribution = np.full(len(error), np.nan)
    total = 0.0
    for i in range(len(index)):
        weighted = 0.0
        for j in range(len(index)):
            weighted += precision[i, j] * (error[index[j]] - mean[index[j]])
        total += weighted * (error[index[i]] - mean[index[i]])
        contribution[index[i]] = weighted * weighted / precision[i, i]
    return np.sqrt(max(total, 0.0)), contribution


@jit
def deviation(predictor, judges, joined, mean, index, precision):
    """Return the `distance` of the `errors` of a sample."""
    return distance(errors(predictor, judges, joined), mean, index, precision)
