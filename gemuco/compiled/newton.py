"""Gauss-Newton with damping (Levenberg, Marquardt) for sums of norms, with bounds and with rows that must be zero.

A norm is not a square, so each one is weighed by its inverse (iteratively reweighted least squares): w ||r|| is at most
w r.r / (2 |r|) + w |r| / 2, with equality at the point, so a step that lowers the squares lowers the loss. Several
dampings are tried at once, and the one with the lowest loss is used.
"""

import numpy as np
from numba import types

from gemuco.compiled.chain import alone, space
from gemuco.compiled.jit import jit
from gemuco.compiled.problem import differences, inside, jacobian, length, losses, muscle_slopes, room

DAMPINGS = 4
"""This many dampings are tried at once, each `APART` times the one before."""
APART = 30.0
FIRST = 1e-4
"""The smallest damping of the first step is this share of the curvature."""
LEAST, MOST = 1e-9, 1e9
"""The damping stays between these; when even the largest does not lower the loss, the search ends."""
STRIDE = 1.0
"""An element moves at most this far in one step (inputs in standard deviations, z as it is), because the network is
not reliable far from the data."""
FLOOR = 1e-4
"""A norm below this is weighed as if it were this large, because at zero its weight would be infinite."""
BREACH = 100.0
"""While a step is judged, a row that must be zero adds this loss per unit of its value."""
RETURNS = 10
"""The search ends with this many Newton steps towards the point where the held rows are zero."""
RIDGE = 1e-9

_clock = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.voidptr))


@jit
def monotonic():
    """Return the time of `time.monotonic` [s]."""
    now = np.empty(2, np.int64)
    _clock(1, now.ctypes.data)
    return now[0] + 1e-9 * now[1]


@jit
def weighed(problem, rows, rest, inner, slopes, curvature, way):
    """Compute curvature, shape (n, n), and gradient, shape (n,), of the squares that replace the loss at a point.

    Args:
        problem: The loss.
        rows: r at the point, shape (1, rows).
        rest: Missing torque of the muscles there [N m], shape (1, joints).
        inner: Values of the muscles' network there.
        slopes: Derivatives of r, shape (n, rows).
        curvature: Result, in its lower half.
        way: Result, the gradient.
    """
    count = len(way)
    way[:] = 0.0
    curvature[:] = 0.0
    for block in range(len(problem.weights)):
        begin, end = problem.ends[block], problem.ends[block + 1]
        share = problem.weights[block] / np.hypot(length(rows[0], begin, end), FLOOR)
        add(curvature, way, slopes, rows, begin, end, share)
    balance = problem.balance
    if balance.weight > 0.0:
        joints, lines = len(balance.joints), len(balance.lines)
        ways = np.zeros((joints, joints), rows.dtype)
        for i in range(joints):
            ways[i, i] = 1.0
        bent = muscle_slopes(balance, inner, ways)
        outer = np.zeros((count, joints), rows.dtype)
        for p in range(count):
            for j in range(joints):
                for i in range(lines):
                    outer[p, j] += slopes[p, balance.rows[0] + i] * bent[i, j]
                if balance.rows[1] >= 0:
                    for i in range(joints):
                        outer[p, j] += slopes[p, balance.rows[1] + i] * bent[lines + i, j]
        share = balance.weight / np.hypot(length(rest[0], 0, joints), FLOOR)
        add(curvature, way, outer, rest, 0, joints, share)


@jit
def add(curvature, way, slopes, rows, begin, end, share):
    """Add the part of one norm, whose derivatives are the columns `begin` to `end` of `slopes`."""
    for i in range(len(way)):
        for k in range(begin, end):
            way[i] += share * slopes[i, k] * rows[0, k]
        for j in range(i + 1):
            total = 0.0
            for k in range(begin, end):
                total += slopes[i, k] * slopes[j, k]
            curvature[i, j] += share * total


@jit
def step(curvature, way, stuck, slopes, rows, held, damping):
    """Return the step that lowers the damped squares most and takes the held rows to zero, shape (n,).

    Stuck elements do not move. The held rows are included by their Schur complement.
    """
    count = len(way)
    system, move = np.zeros((count, count)), np.zeros(count)
    largest = 0.0
    for i in range(count):
        largest = max(largest, curvature[i, i])
    for i in range(count):
        if stuck[i]:
            system[i, i] = 1.0
            continue
        for j in range(i):
            if not stuck[j]:
                system[i, j] = curvature[i, j]
        system[i, i] = (1.0 + damping) * curvature[i, i] + (RIDGE + 1e-3 * damping) * largest + 1e-12
        move[i] = -way[i]
    cholesky(system)
    substitute(system, move)
    if held:
        first = len(rows) - held
        aside, residual = np.zeros((held, count)), np.empty(held)
        for k in range(held):
            for i in range(count):
                if not stuck[i]:
                    aside[k, i] = slopes[i, first + k]
            substitute(system, aside[k])
        square = np.zeros((held, held))
        for k in range(held):
            residual[k] = rows[first + k]
            for i in range(count):
                residual[k] += slopes[i, first + k] * move[i]
                for m in range(held):
                    square[k, m] += slopes[i, first + k] * aside[m, i]
        for k in range(held):
            square[k, k] += 1e-9 * (1.0 + square[k, k])
        cholesky(square)
        substitute(square, residual)
        for k in range(held):
            for i in range(count):
                move[i] -= aside[k, i] * residual[k]
    return move


@jit
def cholesky(matrix):
    """Replace the lower half of a positive definite matrix by L of its decomposition L L^T."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[i, i] = np.sqrt(max(total, 1e-30))
            else:
                matrix[i, j] = total / matrix[j, j]


@jit
def substitute(lower, right):
    """Solve L L^T x = right in place."""
    count = len(right)
    for i in range(count):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * right[k]
        right[i] = total / lower[i, i]
    for i in range(count - 1, -1, -1):
        total = right[i]
        for k in range(i + 1, count):
            total -= lower[k, i] * right[k]
        right[i] = total / lower[i, i]


@jit
def back(problem, point):
    """Move a point, shape (1, n), to where the held rows are zero by the shortest Newton steps, in place."""
    held, count = problem.held, point.shape[1]
    values = space(problem.chain, 1)
    square, residual = np.zeros((held, held)), np.zeros(held)
    for _ in range(RETURNS):
        rows = differences(problem, point, values)
        slopes = jacobian(problem, values, 1, 0)
        begin = slopes.shape[1] - held
        for k in range(held):
            residual[k] = rows[0, begin + k]
            for m in range(k + 1):
                square[k, m] = 1e-6 if k == m else 0.0
                for i in range(count):
                    square[k, m] += slopes[i, begin + k] * slopes[i, begin + m]
        cholesky(square)
        substitute(square, residual)
        for i in range(count):
            for k in range(held):
                point[0, i] -= slopes[i, begin + k] * residual[k]
        inside(problem, point)


@jit
def pick(problem, points, values, inner):
    """Return the best of several points, and the values that a step from there needs.

    Args:
        problem: The loss.
        points: Points, shape (points, n); they are moved into the bounds.
        values: Memory for the network's values at all points.
        inner: Memory for the values of the muscles' network (`room`).

    Returns:
        Index of the point, its loss, its rows, shape (1, rows), the missing torque of its muscles [N m], shape
        (1, joints), and the values of both networks there.
    """
    inside(problem, points)
    rows, count = differences(problem, points, values), len(points)
    loss, rest = losses(problem, rows, BREACH, inner)
    best = np.argmin(loss)
    one = alone(problem.chain, values, count, best)
    other = inner[:0]
    if problem.balance.weight > 0.0:
        other = alone(problem.balance.chain, inner, count, best)
    return best, loss[best], rows[best : best + 1].copy(), rest[best : best + 1].copy(), one, other


@jit
def search(problem, starts, iterations, tolerance, until):
    """Minimise a problem.

    Args:
        problem: The loss.
        starts: First points, shape (starts, n); the search begins at the best of them.
        iterations: Largest number of steps.
        tolerance: The search ends when two consecutive steps lower the loss by less than this share of it.
        until: The search ends when `monotonic` is later than this [s].

    Returns:
        The best point, shape (n,), its loss without the part of the held rows, the loss after every iteration, shape
        (done + 1,), and whether the time limit ended the search.
    """
    size, points = starts.shape[1], starts.copy()
    first = pick(problem, points, space(problem.chain, len(points)), room(problem.balance, len(points)))
    chosen, loss, rows, rest, values, inner = first
    point = points[chosen : chosen + 1].copy()
    history = np.empty(iterations + 1)
    history[0] = loss
    outer, within = space(problem.chain, DAMPINGS), room(problem.balance, DAMPINGS)
    tried = np.empty((DAMPINGS, size), starts.dtype)
    curvature, way, stuck = np.empty((size, size)), np.empty(size), np.zeros(size, np.bool_)
    damping, small, done, is_late = FIRST, 0, 0, False
    while done < iterations and small < 2 and damping < MOST:
        if monotonic() > until:
            is_late = True
            break
        slopes = jacobian(problem, values, 1, 0)
        weighed(problem, rows, rest, inner, slopes, curvature, way)
        for i in range(size):
            low, high = problem.bounds[0, i], problem.bounds[1, i]
            stuck[i] = (point[0, i] <= low and way[i] > 0.0) or (point[0, i] >= high and way[i] < 0.0)
        is_better = False
        while not is_better and damping < MOST:
            for k in range(DAMPINGS):
                move = step(curvature, way, stuck, slopes, rows[0], problem.held, damping * APART**k)
                stride = 1.0
                for i in range(size):
                    stride = max(stride, abs(move[i]) / STRIDE)
                for i in range(size):
                    tried[k, i] = point[0, i] + move[i] / stride
            chosen, least, its_rows, its_rest, its_values, its_inner = pick(problem, tried, outer, within)
            is_better = least < loss
            if is_better:
                small = small + 1 if loss - least < tolerance * abs(loss) else 0
                loss, rows, rest, values, inner = least, its_rows, its_rest, its_values, its_inner
                for i in range(size):
                    point[0, i] = tried[chosen, i]
                damping = max(LEAST, damping * APART ** (chosen - 1))
            else:
                damping *= APART**DAMPINGS
        done += 1
        history[done] = loss
    if problem.held:
        back(problem, point)
        loss = losses(problem, differences(problem, point, values), 0.0, inner)[0][0]
    return point[0], loss, history[: done + 1], is_late
