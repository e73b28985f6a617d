"""Gauss-Newton with damping (Levenberg, Marquardt) for sums of norms, with bounds and with rows that must be zero.

A norm is no square, so each is weighed by its inverse (iteratively reweighted least squares): near the point
w ||r|| = w r.r / (2 |r|) + w |r| / 2 touches it from above, and a step that lowers the squares lowers the loss. Several
dampings are tried at once, and the loss itself says which of them was best.
"""

import numpy as np
from numba import types

from gemuco.compiled.chain import alone, space
from gemuco.compiled.jit import jit
from gemuco.compiled.problem import differences, inside, jacobian, length, losses, muscle_slopes, room

DAMPINGS = 4
"""Dampings tried at once, each `APART` times the one before."""
APART = 30.0
FIRST = 1e-4
"""Smallest damping of the first step, as a share of the curvature."""
LEAST, MOST = 1e-9, 1e9
"""Between them the damping moves; where even the largest lowers nothing, the search has ended."""
STRIDE = 1.0
"""No number moves further than this in one step, inputs in standard deviations and z as it is: far from the data a
network says anything."""
FLOOR = 1e-4
"""A norm below this is weighed as if it were this large: at zero its weight would be infinite."""
BREACH = 100.0
"""Loss per unit of a row that must be zero and is not, while a step is judged."""
RETURNS = 10
"""Newton steps to where the held rows are zero, at the end."""
RIDGE = 1e-9

_clock = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.voidptr))


@jit
def monotonic():
    """The clock of `time.monotonic` [s]."""
    now = np.empty(2, np.int64)
    _clock(1, now.ctypes.data)
    return now[0] + 1e-9 * now[1]


@jit
def weighed(problem, rows, rest, inner, slopes, curvature, way):
    """Curvature, shape (n, n), and gradient, shape (n,), of the squares that touch the loss at a point.

    Args:
        problem: What is minimised.
        rows: r at the point, shape (1, rows).
        rest: What the muscles lack there [N m], shape (1, joints).
        inner: Values of their network there.
        slopes: Its derivatives, shape (n, rows).
        curvature: Is filled in, its lower half.
        way: Is filled in.
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
    """The part of one norm, whose derivatives are some columns of `slopes`."""
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
    """The step that lowers the damped squares most while it takes the held rows to zero, shape (n,).

    Stuck numbers do not move. The held rows come in by their Schur complement.
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
        aside, amiss = np.zeros((held, count)), np.empty(held)
        for k in range(held):
            for i in range(count):
                if not stuck[i]:
                    aside[k, i] = slopes[i, first + k]
            substitute(system, aside[k])
        square = np.zeros((held, held))
        for k in range(held):
            amiss[k] = rows[first + k]
            for i in range(count):
                amiss[k] += slopes[i, first + k] * move[i]
                for m in range(held):
                    square[k, m] += slopes[i, first + k] * aside[m, i]
        for k in range(held):
            square[k, k] += 1e-9 * (1.0 + square[k, k])
        cholesky(square)
        substitute(square, amiss)
        for k in range(held):
            for i in range(count):
                move[i] -= aside[k, i] * amiss[k]
    return move


@jit
def cholesky(matrix):
    """L of L L^T in place of the lower half of a positive definite matrix."""
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
    """Bring a point, shape (1, n), to where the held rows are zero, by Newton steps of least length, in place."""
    held, count = problem.held, point.shape[1]
    values = space(problem.chain, 1)
    square, amiss = np.zeros((held, held)), np.zeros(held)
    for _ in range(RETURNS):
        rows = differences(problem, point, values)
        slopes = jacobian(problem, values, 1, 0)
        begin = slopes.shape[1] - held
        for k in range(held):
            amiss[k] = rows[0, begin + k]
            for m in range(k + 1):
                square[k, m] = 1e-6 if k == m else 0.0
                for i in range(count):
                    square[k, m] += slopes[i, begin + k] * slopes[i, begin + m]
        cholesky(square)
        substitute(square, amiss)
        for i in range(count):
            for k in range(held):
                point[0, i] -= slopes[i, begin + k] * amiss[k]
        inside(problem, point)


@jit
def look(problem, points, values, inner):
    """The best of several points: which, its loss, and what a step from there needs to know of it.

    Args:
        problem: What is minimised.
        points: Shape (points, n); they are moved into the bounds.
        values: Room for the network's values at all of them.
        inner: `room` for those of the muscles' network.

    Returns:
        Which, its loss, its rows, shape (1, rows), what its muscles lack, shape (1, joints), and the values of both
        networks there.
    """
    inside(problem, points)
    rows, count = differences(problem, points, values), len(points)
    found, rest = losses(problem, rows, BREACH, inner)
    best = np.argmin(found)
    one = alone(problem.chain, values, count, best)
    other = inner[:0]
    if problem.balance.weight > 0.0:
        other = alone(problem.balance.chain, inner, count, best)
    return best, found[best], rows[best : best + 1].copy(), rest[best : best + 1].copy(), one, other


@jit
def search(problem, starts, iterations, tolerance, until):
    """Minimise a problem.

    Args:
        problem: What.
        starts: First points, shape (starts, n); the best of them is where it begins.
        iterations: At most so many steps.
        tolerance: It ends when two steps in a row lower the loss by less than this share of it.
        until: It ends when `monotonic` is later than this [s].

    Returns:
        The best point, shape (n,), its loss without what held rows cost, the loss after every iteration, shape
        (done + 1,), and whether time was up before the end.
    """
    size, points = starts.shape[1], starts.copy()
    first = look(problem, points, space(problem.chain, len(points)), room(problem.balance, len(points)))
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
            chosen, least, its_rows, its_rest, its_values, its_inner = look(problem, tried, outer, within)
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
