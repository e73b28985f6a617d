"""One sample for a bank of beliefs about p; see `gemuco.bias.Kalman`, which says what it means."""

import numpy as np

from gemuco.compiled.innovation import innovations
from gemuco.compiled.jit import jit
from gemuco.compiled.newton import cholesky, substitute


@jit
def invert(matrix, out):
    """The inverse of a positive definite matrix (k, k) into `out`; returns the logarithm of its determinant."""
    size = len(matrix)
    lower, volume = matrix.copy(), 0.0
    cholesky(lower)
    for i in range(size):
        volume += 2.0 * np.log(lower[i, i])
        for j in range(size):
            out[i, j] = 1.0 if i == j else 0.0
        substitute(lower, out[i])
    return volume


@jit
def gained(slope, error, information, pull):
    """S^T S into `information` (k, k) and S^T e into `pull` (k,), of one belief's slope S (n, k) and error e (n,)."""
    for i in range(slope.shape[1]):
        pull[i] = 0.0
        for n in range(len(slope)):
            pull[i] += slope[n, i] * error[n]
        for j in range(i + 1):
            total = 0.0
            for n in range(len(slope)):
                total += slope[n, i] * slope[n, j]
            information[i, j] = information[j, i] = total


@jit
def errors_at(predictor, row, at, far, pairs, raw, slope):
    """Errors of the beliefs that are `far`, and their derivatives, at p `at`, into `raw` and `slope`."""
    chosen = np.flatnonzero(far)
    size = at.shape[1]
    rows, biases = np.empty((len(chosen), len(row))), np.empty((len(chosen), size), np.float32)
    for i in range(len(chosen)):
        for j in range(len(row)):
            rows[i, j] = row[j]
        for j in range(size):
            biases[i, j] = at[chosen[i], j]
    found, moved = innovations(predictor, rows, biases, *pairs)
    for i in range(len(chosen)):
        for n in range(raw.shape[1]):
            raw[chosen[i], n] = found[i, n]
            for j in range(size):
                slope[chosen[i], n, j] = moved[i, n, j]


@jit
def place_newcomer(at, raw, slope):
    """The last belief knows nothing: it is linearised where the sample fits best."""
    nearest, least, last = 0, np.inf, len(at) - 1
    for h in range(len(at)):
        square = 0.0
        for n in range(raw.shape[1]):
            square += raw[h, n] * raw[h, n]
        if square < least:
            nearest, least = h, square
    for j in range(at.shape[1]):
        at[last, j] = at[nearest, j]
    for n in range(raw.shape[1]):
        raw[last, n] = raw[nearest, n]
        for j in range(at.shape[1]):
            slope[last, n, j] = slope[nearest, n, j]


@jit
def linearise(predictor, row, mean, pairs, near, passes, error, slope, before, scale):
    """Errors and derivatives of every belief where the sample moves it to, as if they had been taken at `mean`.

    Args:
        predictor: The network.
        row: The sample [standard deviations], shape (size,).
        mean: p of every belief, shape (beliefs, k).
        pairs: `through`, `tails`, `index` and `whiten` of `innovations`.
        near: What moves less than this, shape (k,), is not linearised again.
        passes: How often at most.
        error: Is filled in, shape (beliefs, n).
        slope: Is filled in, shape (beliefs, n, k).
        before: Inverse covariance of every belief, shape (beliefs, k, k).
        scale: Of the errors' variance.
    """
    count, size = mean.shape
    at, far, raw = mean.copy(), np.ones(count, np.bool_), np.empty_like(error)
    information, pull = np.empty((size, size)), np.empty(size)
    for turn in range(passes):
        if not far.any():
            break
        errors_at(predictor, row, at, far, pairs, raw, slope)
        if turn == 0:
            place_newcomer(at, raw, slope)
        for h in range(count):
            if not far[h]:
                continue
            for n in range(error.shape[1]):
                error[h, n] = raw[h, n]
                for j in range(size):
                    error[h, n] -= slope[h, n, j] * (mean[h, j] - at[h, j])
            gained(slope[h], error[h], information, pull)
            add(before[h], information, 1.0 / scale, information)
            cholesky(information)
            substitute(information, pull)
            far[h] = False
            for j in range(size):
                there = mean[h, j] + pull[j] / scale
                far[h] |= abs(there - at[h, j]) > near[j]
                at[h, j] = there


@jit
def add(one, other, share, out):
    """The sum one + share * other into `out`, shapes (k, k)."""
    for i in range(len(one)):
        for j in range(len(one)):
            out[i, j] = one[i, j] + share * other[i, j]


@jit
def oddness(before, information, pull, error, scale):
    """How badly a belief foretold the sample, and the logarithm of the determinant of what is known of p after it."""
    size = len(pull)
    known, step, odd, volume = np.empty((size, size)), pull.copy(), 0.0, 0.0
    add(before, information, 1.0 / scale, known)
    cholesky(known)
    substitute(known, step)
    for n in range(len(error)):
        odd += error[n] * error[n] / scale
    for i in range(size):
        odd -= pull[i] * step[i] / (scale * scale)
        volume += 2.0 * np.log(known[i, i])
    return max(odd, 0.0), volume


@jit
def see(predictor, row, mean, covariance, weight, pairs, near, numbers):
    """Weigh all beliefs by a sample, and move those that are not of a known condition.

    Args:
        predictor: The network.
        row: The sample [standard deviations], shape (size,).
        mean: p of every belief, shape (beliefs, k); the last one is the newcomer.
        covariance: Of every p, shape (beliefs, k, k).
        weight: Logarithm of how likely each is, shape (beliefs,).
        pairs: `through`, `tails`, `index` and `whiten` of `innovations`.
        near: What moves less than this is not linearised again, shape (k,).
        numbers: How many conditions are known, how often it is linearised, the errors' scale and degrees of freedom,
            the logarithm of their volume, and of the smallest weight.

    Returns:
        How odd the sample was for all of them, 1 if as usual. `mean`, `covariance` and `weight` are changed in place.
    """
    known, passes, scale, freedom, log_volume, faintest = numbers
    count, size = mean.shape
    n = len(pairs[2])
    error, slope = np.empty((count, n)), np.empty((count, n, size))
    before, volumes = np.empty((count, size, size)), np.empty(count)
    for h in range(count):
        volumes[h] = invert(covariance[h], before[h])
    linearise(predictor, row, mean, pairs, near, passes, error, slope, before, scale)
    information, pull = np.empty((size, size)), np.empty(size)
    share, oddity = 0.0, 0.0
    for h in range(count):
        gained(slope[h], error[h], information, pull)
        odd, gain = oddness(before[h], information, pull, error[h], scale)
        trust = (freedom + n) / (freedom + odd)
        foretold = np.exp(weight[h])
        share += foretold
        oddity += foretold * trust * odd
        volume = log_volume + n * np.log(scale) + volumes[h] + gain
        weight[h] -= 0.5 * volume + 0.5 * (freedom + n) * np.log1p(odd / freedom)
        if h >= known:
            counts = min(trust, 1.0) / scale
            add(before[h], information, counts, information)
            invert(information, covariance[h])
            for i in range(size):
                for j in range(size):
                    mean[h, i] += covariance[h, i, j] * pull[j] * counts
    largest = weight.max()
    for h in range(count):
        weight[h] = max(weight[h] - largest, faintest)
    return oddity / share / n
