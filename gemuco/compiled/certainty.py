"""Distance of one sample from what was learned, and the std of its estimates."""

import numpy as np

from gemuco.compiled.jit import jit

NEAREST = 3
"""The distance is the mean over this many of the nearest anchors."""


@jit
def nearest(anchors, offsets, x):
    """Return the mean distance of a sample from its nearest anchors [standard deviations].

    Args:
        anchors: Elements of the anchors [standard deviations], shape (n, anchors), float32.
        offsets: Squared distance of p from that of every anchor, less the smallest of them, shape (anchors,), float32.
        x: The same elements of the sample, shape (n,), float32.
    """
    squared = offsets.copy()
    for i in range(len(x)):
        value = x[i]
        for j in range(len(squared)):
            squared[j] += (anchors[i, j] - value) * (anchors[i, j] - value)
    best = np.full(NEAREST, np.inf)
    for j in range(len(squared)):
        if squared[j] < best[-1]:
            place = NEAREST - 1
            while place > 0 and best[place - 1] > squared[j]:
                best[place] = best[place - 1]
                place -= 1
            best[place] = squared[j]
    total, count = 0.0, 0
    for place in range(NEAREST):
        if np.isfinite(best[place]):
            total += np.sqrt(best[place])
            count += 1
    return total / max(count, 1)


@jit
def novelty(anchors, offsets, precision, elements, ranges, scale, joined, residual, logs):
    """Return how new a sample is, by four standardised measures.

    Args:
        anchors: See `nearest`.
        offsets: See `nearest`.
        precision: Inverse second moments of the features 1, x, and the squares of x, shape (1 + 2 n,) * 2.
        elements: Positions of x in the layout, shape (n,).
        ranges: Lowest and highest learned value of x [its unit], shape (2, n).
        scale: Mean and standard deviation of every element [its unit], shape (2, size).
        joined: Every element of the layout [its unit], shape (size,).
        residual: Error of the network on the given values [standard deviations]; NaN if it predicts none of them.
        logs: Mean, standard deviation, and smallest and largest standardised value of each measure, shape (4, 4).

    Returns:
        The logarithms of distance, leverage and residual, and the place between the edges of the ranges, all
        standardised; the leverage as a share of its largest usual value; and the element of x furthest outside of its
        range, as an index into `elements`, with its distance from the range as a share of the range's width, negative
        inside; shape (7,).
    """
    count = len(elements)
    x, phi, result = np.empty(count, np.float32), np.ones(1 + 2 * count), np.zeros(7)
    result[5], result[6] = -1.0, -0.5
    for i in range(count):
        raw = joined[elements[i]]
        value = (raw - scale[0, elements[i]]) / scale[1, elements[i]]
        x[i] = value
        phi[1 + i] = value
        phi[1 + count + i] = value * value
        over = max(ranges[0, i] - raw, raw - ranges[1, i]) / max(ranges[1, i] - ranges[0, i], 1e-12)
        if over > result[6]:
            result[5], result[6] = i, over
    leverage = 1.0
    for i in range(len(phi)):
        part = 0.5 * precision[i, i] * phi[i]
        for j in range(i):
            part += precision[i, j] * phi[j]
        leverage += 2.0 * part * phi[i]
    result[0] = (np.log(max(nearest(anchors, offsets, x), 1e-9)) - logs[0, 0]) / logs[0, 1]
    result[1] = (np.log(max(leverage, 1.0)) - logs[1, 0]) / logs[1, 1]
    if np.isfinite(residual):
        result[2] = (np.log(max(residual, 1e-9)) - logs[2, 0]) / logs[2, 1]
    result[3] = (result[6] - logs[3, 0]) / logs[3, 1]
    result[4] = max(1.0, leverage / np.exp(logs[1, 0] + logs[1, 1] * logs[1, 3]))
    return result


@jit
def novelties(anchors, own, precision, elements, ranges, rows, biases, residuals):
    """Return the first four measures of `novelty` of several samples, before standardisation, shape (samples, 4).

    Args:
        anchors: See `nearest`.
        own: Standardised p of every anchor, shape (anchors, b).
        precision: See `novelty`.
        elements: See `novelty`.
        ranges: Lowest and highest learned value of x [standard deviations], shape (2, n).
        rows: Samples [standard deviations], shape (samples, size).
        biases: Standardised p of every sample, shape (samples, b).
        residuals: See `novelty`, shape (samples,).
    """
    width = biases.shape[1]
    result, logs, scale = np.empty((len(rows), 4)), np.zeros((4, 4)), np.zeros((2, rows.shape[1]))
    logs[:, 1], scale[1] = 1.0, 1.0
    offsets = np.empty(len(own), np.float32)
    for row in range(len(rows)):
        for j in range(len(own)):
            total = 0.0
            for k in range(width):
                total += (own[j, k] - biases[row, k]) ** 2
            offsets[j] = total
        z = novelty(anchors, offsets, precision, elements, ranges, scale, rows[row], residuals[row], logs)
        result[row] = z[:4]
    return result


@jit
def spread(
    anchors, offsets, precision, elements, logs, ranges, slopes, expected, more, knots, growth, scale, joined,
    residual, requested, std,
):  # fmt: skip
    """Write the std of the requested elements of a sample.

    Args:
        anchors: See `nearest`.
        offsets: See `nearest`.
        precision: See `novelty`.
        elements: See `novelty`.
        logs: See `novelty`.
        ranges: See `novelty`.
        slopes: Logarithm of the std by 1 and the four standardised measures, shape (size, 5).
        expected: Expected error of every element [its unit], shape (size,).
        more: Further variance of every element, of an uncertain p [its unit squared], shape (size,).
        knots: Distances of the growth [standard deviations], ascending, shape (k,).
        growth: Variance by which the body's nonlinear part differs at each distance [unit squared], shape (k, size).
        scale: See `novelty`.
        joined: See `novelty`.
        residual: See `novelty`.
        requested: Whether each element is requested, truth values, shape (size,).
        std: Result for the requested elements [unit], shape (size,).

    Returns:
        See `novelty`.
    """
    z = novelty(anchors, offsets, precision, elements, ranges, scale, joined, residual, logs)
    capped = np.empty(4)
    for k in range(4):
        capped[k] = min(max(z[k], logs[k, 2]), logs[k, 3])
    far = np.exp(logs[0, 0] + logs[0, 1] * z[0])
    usual = np.exp(logs[0, 0] + logs[0, 1] * logs[0, 3])
    for i in range(len(std)):
        if requested[i]:
            size = slopes[i, 0]
            for k in range(4):
                size += slopes[i, 1 + k] * capped[k]
            inner = expected[i] * np.exp(size)
            outer = grown(knots, growth, i, far) - grown(knots, growth, i, usual) if far > usual else 0.0
            std[i] = np.sqrt(inner * inner * z[4] + more[i] + max(outer, 0.0))
    return z


@jit
def grown(knots, growth, element, distance):
    """Return the growth of one element at a distance; behind the last knot it rises with the square."""
    last = len(knots) - 1
    if distance >= knots[last]:
        return growth[last, element] * (distance / knots[last]) ** 2
    if distance <= knots[0]:
        return growth[0, element] * (distance / knots[0])
    k = 1
    while knots[k] < distance:
        k += 1
    share = (distance - knots[k - 1]) / (knots[k] - knots[k - 1])
    return growth[k - 1, element] + share * (growth[k, element] - growth[k - 1, element])
