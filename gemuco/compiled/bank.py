"""One sample for a bank of beliefs about p; see `gemuco.adaption.recognise.Kalman`, which says what it means."""

import numpy as np

from gemuco.compiled.beliefs import add, begin_anew, thin
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
def point_near(points, at, near):
    """The first of some points that a p, shape (k,), differs from by no more than `near`; -1 if there is none."""
    for i in range(len(points)):
        is_near = True
        for j in range(len(at)):
            is_near &= abs(points[i, j] - at[j]) <= near[j]
        if is_near:
            return i
    return -1


@jit
def best_point(raw):
    """Which point the sample fits best, of errors of shape (points, n)."""
    nearest, least = 0, np.inf
    for i in range(len(raw)):
        square = 0.0
        for n in range(raw.shape[1]):
            square += raw[i, n] * raw[i, n]
        if square < least:
            nearest, least = i, square
    return nearest


@jit
def linearise(predictor, row, mean, pairs, near, rules, error, slope, before, scale):
    """Errors and derivatives of every belief where the sample moves it to, as if they had been taken at `mean`.

    A belief takes the errors and derivatives of another one's point if that is near enough. The last belief knows
    nothing: it is linearised first at that point of the others where the sample fits best. Known conditions stay where
    they are, and a straight line is enough for what little their p is in doubt.

    Args:
        predictor: The network.
        row: The sample [standard deviations], shape (size,).
        mean: p of every belief, shape (beliefs, k).
        pairs: `through`, `tails`, `index` and `whiten` of `innovations`.
        near: A p that differs from a point by no more than this, shape (k,), is linearised there.
        rules: Numbers.
        error: Is filled in, shape (beliefs, n).
        slope: Is filled in, shape (beliefs, n, k).
        before: Inverse covariance of every belief, shape (beliefs, k, k).
        scale: Of the errors' variance.
    """
    count, size = mean.shape
    width = error.shape[1]
    points, raw = np.empty((count * rules.passes, size)), np.empty((count * rules.passes, width))
    moved, done = np.empty((count * rules.passes, width, size)), 0
    at, far, chosen = mean.copy(), np.ones(count, np.bool_), np.zeros(count, np.int64)
    information, pull = np.empty((size, size)), np.empty(size)
    for turn in range(rules.passes):
        fresh = done
        for h in range(count - (turn == 0)):
            if far[h]:
                chosen[h] = point_near(points[:done], at[h], near)
                if chosen[h] < 0:
                    points[done], chosen[h] = at[h], done
                    done += 1
        if done > fresh:
            some = points[fresh:done].astype(np.float32)
            raw[fresh:done], moved[fresh:done] = innovations(predictor, row.reshape(1, -1), some, *pairs)
        if turn == 0:
            chosen[count - 1] = best_point(raw[:done])
        for h in range(count):
            if not far[h]:
                continue
            point = chosen[h]
            for n in range(width):
                error[h, n] = raw[point, n]
                for j in range(size):
                    slope[h, n, j] = moved[point, n, j]
                    error[h, n] -= slope[h, n, j] * (mean[h, j] - points[point, j])
            far[h] = False
            if h < rules.known:
                continue
            gained(slope[h], error[h], information, pull)
            add(before[h], information, 1.0 / scale, information)
            cholesky(information)
            substitute(information, pull)
            for j in range(size):
                at[h, j] = mean[h, j] + pull[j] / scale
                far[h] |= abs(at[h, j] - points[point, j]) > near[j]


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
def weigh(mean, covariance, weight, error, slope, before, volumes, log_volume, scale, rules):
    """Weigh all beliefs by a linearised sample, and move those that are not of a known condition.

    Args:
        mean: p of every belief, shape (beliefs, k).
        covariance: Of every p, shape (beliefs, k, k).
        weight: Logarithm of how likely each is, shape (beliefs,).
        error: Of every belief, shape (beliefs, n).
        slope: Of every belief, shape (beliefs, n, k).
        before: Inverse of the covariance, shape (beliefs, k, k).
        volumes: Logarithm of the determinant of the covariance, shape (beliefs,).
        log_volume: Of the errors' covariance.
        scale: Of the errors' variance.
        rules: Numbers.

    Returns:
        How odd the sample was for all of them, 1 if as usual. `mean`, `covariance` and `weight` are changed in place.
    """
    count, size = mean.shape
    n, freedom = error.shape[1], rules.freedom
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
        if h >= rules.known:
            counts = min(trust, 1.0) / scale
            add(before[h], information, counts, information)
            invert(information, covariance[h])
            for i in range(size):
                for j in range(size):
                    mean[h, i] += covariance[h, i, j] * pull[j] * counts
    largest = weight.max()
    for h in range(count):
        weight[h] = max(weight[h] - largest, rules.faintest)
    return oddity / share / n


@jit
def see(predictor, row, beliefs, count, prior, pairs, log_volume, near, scale, rules):
    """Weigh all beliefs by a sample, and move those that are not of a known condition.

    Args:
        predictor: The network.
        row: The sample [standard deviations], shape (size,).
        beliefs: Are changed in place.
        count: How many there are.
        prior: Mean, shape (k,), and covariance, shape (k, k), of the p of a body that is not known.
        pairs: `through`, `tails`, `index` and `whiten` of `innovations`.
        log_volume: Logarithm of the determinant of the errors' covariance.
        near: See `linearise`, shape (k,).
        scale: Of the errors' variance.
        rules: Numbers.

    Returns:
        How odd the sample was for all of them, 1 if as usual, and how many beliefs there are now.
    """
    begin_anew(beliefs, count, prior[0], prior[1], rules)
    count += 1
    mean, covariance, weight = beliefs.mean[:count], beliefs.covariance[:count], beliefs.weight[:count]
    size, n = mean.shape[1], len(pairs[2])
    error, slope = np.empty((count, n)), np.empty((count, n, size))
    before, volumes = np.empty((count, size, size)), np.empty(count)
    for h in range(count):
        volumes[h] = invert(covariance[h], before[h])
    linearise(predictor, row, mean, pairs, near, rules, error, slope, before, scale)
    odd = weigh(mean, covariance, weight, error, slope, before, volumes, log_volume, scale, rules)
    return odd, thin(beliefs, count, len(beliefs.age) - 1, rules.known)
