"""Anomaly score of one sample (paper, II-K): its prediction errors and their Mahalanobis distance."""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.chain import first, forward, space
from gemuco.compiled.jit import jit

NEIGHBOURS = 5
"""A sample is compared with this number of nearest known samples."""

BASE = 2.0
"""Both parts of a deviation count from this many standard deviations below their mean."""


class Judges(NamedTuple):
    """Masks by which the elements of x_out are judged.

    Attributes:
        through: 1 for elements of x_in that a mask lets through, else 0, shape (masks, in_size).
        paths: Regression of the code l under every mask, shape (masks, in_size + 1, width).
        tails: m and p of every mask, shape (masks, x_in + bias_size).
        directs: Part of the linear path in x_out under every mask, shape (masks, in_size + 2, out_size).
        mask: Index of the mask that judges each element, shape (out_size,).
    """

    through: np.ndarray
    paths: np.ndarray
    tails: np.ndarray
    directs: np.ndarray
    mask: np.ndarray


class Near(NamedTuple):
    """Known samples, for the distance from the nearest of them.

    Attributes:
        cloud: Their measured elements [standard deviations], shape (n, elements).
        own: Mean distance of each from its own nearest neighbours, shape (n,).
        elements: Positions of these elements in the layout, shape (elements,).
    """

    cloud: np.ndarray
    own: np.ndarray
    elements: np.ndarray


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
            value, share = prediction[row, i], judges.directs[row, count + 1, i]
            if share < 1.0:
                value = share * value + judges.directs[row, count, i]
                for k in range(count):
                    if judges.through[row, k] > 0.0:
                        of = predictor.inputs[k]
                        x = (joined[of] - predictor.scale[0, of]) / predictor.scale[1, of]
                        value += x * judges.directs[row, k, i]
            error[i] = joined[element] - value * predictor.scale[1, element] - predictor.scale[0, element]
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
def residuals(inputs, clips, pairs, maps, scale, joined, p):
    """Return the residuals of a watch (`gemuco.normal.watch.Reading`) [standard deviations], shape (residuals,).

    Args:
        inputs: Positions of the measured inputs, shape (n,).
        clips: Lower and upper clip of products, shape (2, n).
        pairs: Both factors of every product, shape (2, products).
        maps: Residuals by features, shape (1 + n + products, residuals).
        scale: Mean and standard deviation of every element [its unit], shape (2, size).
        joined: Every element of the layout [its unit], shape (size,).
        p: Parametric bias, shape (bias_size,).
    """
    count, size, outputs = len(inputs), len(joined), maps.shape[1]
    clipped, total = np.empty(count), np.empty(outputs)
    for k in range(outputs):
        total[k] = maps[0, k]
    for i in range(count):
        element = inputs[i]
        value = (joined[element] - scale[0, element]) / scale[1, element] if element < size else p[element - size]
        clipped[i] = min(max(value, clips[0, i]), clips[1, i])
        for k in range(outputs):
            total[k] += value * maps[1 + i, k]
    for j in range(pairs.shape[1]):
        product = clipped[pairs[0, j]] * clipped[pairs[1, j]]
        for k in range(outputs):
            total[k] += product * maps[1 + count + j, k]
    return total


@jit
def nearness(cloud, own, elements, scale, joined):
    """Return the mean distance of a sample from its nearest neighbours, as a share of the neighbours' own.

    Args:
        cloud: Known samples, see `Near`.
        own: See `Near`.
        elements: See `Near`.
        scale: Mean and standard deviation of every element [its unit], shape (2, size).
        joined: Every element of the layout [its unit], shape (size,).
    """
    count, width = cloud.shape
    x = np.empty(width)
    for i in range(width):
        element = elements[i]
        x[i] = (joined[element] - scale[0, element]) / scale[1, element]
    best, theirs = np.full(NEIGHBOURS, np.inf), np.ones(NEIGHBOURS)
    for row in range(count):
        squared = 0.0
        for i in range(width):
            squared += (cloud[row, i] - x[i]) ** 2
        if squared < best[-1]:
            place = NEIGHBOURS - 1
            while place > 0 and best[place - 1] > squared:
                best[place], theirs[place] = best[place - 1], theirs[place - 1]
                place -= 1
            best[place], theirs[place] = squared, own[row]
    away, usual = 0.0, 0.0
    for place in range(NEIGHBOURS):
        away += np.sqrt(best[place])
        usual += theirs[place]
    return away / max(usual, 1e-12)


@jit
def deviation(
    network, joined, p, scale, inputs, clips, pairs, maps, kind, cloud, own, near, mean, index, precision, logs, element
):
    """Return the score of a sample, and the contribution of every element, shape (size,).

    The contribution is the drop of the squared Mahalanobis distance without one error of the element, its largest.

    Args:
        network: Errors of the network [unit], shape (out_size,).
        joined: Every element of the layout [its unit], shape (size,).
        p: Parametric bias, shape (bias_size,).
        scale: Mean and standard deviation of every element [its unit], shape (2, size).
        inputs: See `residuals`.
        clips: See `residuals`.
        pairs: See `residuals`.
        maps: See `residuals`.
        kind: Place of every residual behind the network's errors, shape (residuals,).
        cloud: Known samples, see `Near`; without any their distance is not used.
        own: See `Near`.
        near: Elements of the known samples, see `Near`.
        mean: Mean of every error, shape (errors,).
        index: Indices of the judged errors, shape (n,).
        precision: Inverse covariance of the judged errors, shape (n, n).
        logs: `gemuco.normal.statistics.Scale`, shape (5,).
        element: Position in the layout of the element of every error, shape (errors,).
    """
    error = np.full(len(mean), np.nan)
    error[: len(network)] = network
    residual = residuals(inputs, clips, pairs, maps, scale, joined, p)
    for k in range(len(kind)):
        error[len(network) + kind[k]] = residual[k]
    value, of_error = distance(error, mean, index, precision)
    contribution = np.full(len(joined), np.nan)
    for i in index:
        if not contribution[element[i]] >= of_error[i]:
            contribution[element[i]] = of_error[i]
    if len(cloud):
        z = (np.log(max(value, 1e-9)) - logs[0]) / logs[1]
        away = (np.log(max(nearness(cloud, own, near, scale, joined), 1e-9)) - logs[2]) / logs[3]
        z = np.sqrt(max(z + BASE, 0.0) ** 2 + logs[4] * max(away + BASE, 0.0) ** 2) - BASE
        value = np.exp(logs[0] + logs[1] * z)
    return value, contribution
