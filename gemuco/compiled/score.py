"""How unlike normal one sample is (paper, II-K): its prediction errors, and their Mahalanobis distance."""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.chain import first, forward, space
from gemuco.compiled.jit import jit


class Judges(NamedTuple):
    """By which mask each element of x_out is judged.

    Attributes:
        through: 1 for elements of x_in that a mask lets through, else 0, shape (masks, in_size).
        tails: m and p of every mask, shape (masks, x_in + bias_size).
        mask: Which of the masks judges an element, shape (out_size,).
    """

    through: np.ndarray
    tails: np.ndarray
    mask: np.ndarray


@jit
def errors(predictor, judges, joined):
    """Measured minus predicted [unit], shape (out_size,); NaN where one of them is not to be had.

    Args:
        predictor: The network.
        judges: Which mask predicts what.
        joined: Every element of the layout [its unit], shape (size,); NaN where not measured.
    """
    rows, count = judges.through.shape
    values = space(predictor.chain, rows)
    inputs = first(predictor.chain, values, rows)
    complete = np.ones(rows, np.bool_)
    for row in range(rows):
        for i in range(count):
            inputs[row, i] = 0.0
            if judges.through[row, i] > 0.0:
                element = predictor.inputs[i]
                x = (joined[element] - predictor.scale[0, element]) / predictor.scale[1, element]
                if np.isfinite(x):
                    inputs[row, i] = min(max(x, -predictor.clip), predictor.clip)
                else:
                    complete[row] = False
        for i in range(judges.tails.shape[1]):
            inputs[row, count + i] = judges.tails[row, i]
    told = forward(predictor.chain, values, rows)
    found = np.full(len(judges.mask), np.nan)
    for i in range(len(judges.mask)):
        element, row = predictor.outputs[i], judges.mask[i]
        if complete[row]:
            found[i] = joined[element] - told[row, i] * predictor.scale[1, element] - predictor.scale[0, element]
    return found


@jit
def distance(error, mean, index, precision):
    """Mahalanobis distance of the elements `index` of an error, and what each of them adds to its square.

    Args:
        error: Shape (out_size,).
        mean: Mean error of a healthy body, shape (out_size,).
        index: Which elements are judged, shape (n,).
        precision: Inverse covariance of those, shape (n, n).

    Returns:
        The distance; and by how much its square drops without an element, (P e)_i^2 / P_ii, shape (out_size,), NaN
        for those that are not judged.
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
    """`distance` of the `errors` of a sample; see both."""
    return distance(errors(predictor, judges, joined), mean, index, precision)
