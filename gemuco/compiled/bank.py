"""Update of a bank of beliefs about p by one sample; `gemuco.adaption.recognise.Kalman` explains the method."""

import numpy as np

from gemuco.compiled.beliefs import add, begin_anew, thin
from gemuco.compiled.innovation import innovations
from gemuco.compiled.jit import jit
from gemuco.compiled.newton import cholesky, substitute


@jit
def invert(matrix, out):
    """Write the inverse of a positive definite matrix (k, k) into `out`; return the logarithm of its determinant."""
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
    """Write S^T S into `information` (k, k) and S^T e into `pull` (k,), for the slope S (n, k) and error e (n,)."""
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
    """Return the first point whose distance from a p, shape (k,), is at most `near`; -1 without such a point."""
    for i in range(len(points)):
        is_near = True
        for j in range(len(at)):
            is_near &= abs(points[i, j] - at[j]) <= near[j]
        if is_near:
            return i
    return -1


@jit
def best_point(raw):
    """Return the index of the point with the smallest errors; errors have shape (points, n)."""
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
    """Compute errors and derivatives of every belief at the p to which the sample moves it, converted to `mean`.

    A belief shares the linearisation of another belief's point if that point is near enough. The last belief is the new
    one without knowledge of p: it is first linearised at the point of the other beliefs that fits the sample best.
    Known conditions do not move, and one linearisation is enough for their small uncertainty of p.

    Args:
        predictor: The network.
        row: The sample [standard deviations], shape (size,).
        mean: p of every belief, shape (beliefs, k).
        pairs: `through`, `paths`, `tails`, `directs`, `index` and `whiten` of `innovations`.
        near: Largest difference between a p and the point at which it is linearised, shape (k,).
        rules: Constants.
        error: Result, shape (beliefs, n).
        slope: Result, shape (beliefs, n, k).
        before: Inverse covariance of every belief, shape (beliefs, k, k).
        scale: Factor of the errors' variance.
    """
    count, size = mean.shape
    width = error.shape[1]
    points, raw = np.empty((count * rules.passes, size)), np.empty((count * rules.passes, width))
    moved, done = np.empty((count * rules.passes, width, size)), 0
    at, far, index = mean.copy(), np.ones(count, np.bool_), np.zeros(count, np.int64)
    information, pull = np.empty((size, size)), np.empty(size)
    for turn in range(rules.passes):
        fresh = done
        for h in range(count - (turn == 0)):
            if far[h]:
                index[h] = point_near(points[:done], at[h], near)
                if index[h] < 0:
                    points[done], index[h] = at[h], done
                    done += 1
        if done > fresh:
            biases = points[fresh:done].astype(np.float32)
            raw[fresh:done], moved[fresh:done] = innovations(predictor, row.reshape(1, -1), biases, *pairs)
        if turn == 0:
            index[count - 1] = best_point(raw[:done])
        for h in range(count):
            if not far[h]:
                continue
            point = index[h]
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
    """Return the squared, normalised prediction error of a belief, and the log determinant of the new information."""
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
    """Weigh all beliefs by a linearised sample, and update the p of beliefs that are not known conditions.

    Args:
        mean: p of every belief, shape (beliefs, k).
        covariance: Covariance of every p, shape (beliefs, k, k).
        weight: Log likelihood of every belief, shape (beliefs,).
        error: Error of every belief, shape (beliefs, n).
        slope: Derivatives of every belief, shape (beliefs, n, k).
        before: Inverse of the covariance, shape (beliefs, k, k).
        volumes: Logarithm of the determinant of the covariance, shape (beliefs,).
        log_volume: Logarithm of the determinant of the errors' covariance.
        scale: Factor of the errors' variance.
        rules: Constants.

    Returns:
        Mean oddness of the sample, 1 for a usual sample. `mean`, `covariance` and `weight` are changed in place.
    """
    count, size = mean.shape
    n, freedom = error.shape[1], rules.freedom
    information, pull = np.empty((size, size)), np.empty(size)
    share, oddity = 0.0, 0.0
    for h in range(count):
        gained(slope[h], error[h], information, pull)
        odd, gain = oddness(before[h], information, pull, error[h], scale)
        trust = (freedom + n) / (freedom + odd)
        likelihood = np.exp(weight[h])
        share += likelihood
        oddity += likelihood * trust * odd
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
    """Weigh all beliefs by a sample, and update the p of beliefs that are not known conditions.

    Args:
        predictor: The network.
        row: The sample [standard deviations], shape (size,).
        beliefs: The beliefs; they are changed in place.
        count: Number of beliefs.
        prior: Mean, shape (k,), and covariance, shape (k, k), of the p of an unknown body.
        pairs: `through`, `paths`, `tails`, `directs`, `index` and `whiten` of `innovations`.
        log_volume: Logarithm of the determinant of the errors' covariance.
        near: See `linearise`, shape (k,).
        scale: Factor of the errors' variance.
        rules: Constants.

    Returns:
        Mean oddness of the sample, 1 for a usual sample, and the new number of beliefs.
    """
    begin_anew(beliefs, count, prior[0], prior[1], rules)
    count += 1
    mean, covariance, weight = beliefs.mean[:count], beliefs.covariance[:count], beliefs.weight[:count]
    size, n = mean.shape[1], len(pairs[4])
    error, slope = np.empty((count, n)), np.empty((count, n, size))
    before, volumes = np.empty((count, size, size)), np.empty(count)
    for h in range(count):
        volumes[h] = invert(covariance[h], before[h])
    linearise(predictor, row, mean, pairs, near, rules, error, slope, before, scale)
    odd = weigh(mean, covariance, weight, error, slope, before, volumes, log_volume, scale, rules)
    return odd, thin(beliefs, count, len(beliefs.age) - 1, rules.known)
