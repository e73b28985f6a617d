"""What a search minimises, as compiled code takes it: sums of norms of differences that a network predicts.

The terms of a loss are linear in what is predicted, so the network is folded together with them: its first layer takes
nothing but what moves, its last gives the differences themselves, r(p) = D p + c + net(p). What is left is

    loss(p) = sum_k weight_k ||r_k(p)|| + weight ||torque + K (theta - theta_0) + G(theta, f)^T f||

with r_k blocks of r; f and, in simulation, theta are further rows of r, and so is what must be zero.
"""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.blas import times
from gemuco.compiled.chain import Packed, alone, first, forward, mixed, pull, pull_all, push_all, space
from gemuco.compiled.jit import jit

TINY = 1e-9


class Balance(NamedTuple):
    """The torque balance of muscles (`gemuco.search.torque`); nothing where `weight` is 0.

    Attributes:
        chain: From posture and tension, one behind the other, to muscle length.
        back: Its matrices, `chain.turned`.
        joints: For every joint: theta's standard deviation [rad], tau_ext at theta_0 [N m], theta_0 [standard
            deviations], and the stiffness K [N m per standard deviation], shape (joints, 3 + joints).
        lines: For every muscle: f's standard deviation and mean [N], l's standard deviation [m], shape (muscles, 3).
        rows: Where f and theta begin among the rows of r; -1 for theta that is given: it is theta_0.
        weight: Loss per N m.
    """

    chain: Packed
    back: np.ndarray
    joints: np.ndarray
    lines: np.ndarray
    rows: tuple[int, int]
    weight: float


STD, TORQUE, POSTURE, STIFFNESS = range(4)
"""Columns of `Balance.joints`."""
F_STD, F_MEAN, L_STD = range(3)
"""Columns of `Balance.lines`."""


class Problem(NamedTuple):
    """A loss of n numbers p.

    Attributes:
        chain: net, n in and rows out.
        direct: D and, as its last row, c, shape (n + 1, rows).
        ends: Borders of the blocks, shape (blocks + 1,), beginning with 0.
        weights: Of the blocks, shape (blocks,).
        balance: Torque balance.
        held: As many rows at the end must be zero.
        bounds: Lowest and highest p, shape (2, n).
    """

    chain: Packed
    direct: np.ndarray
    ends: np.ndarray
    weights: np.ndarray
    balance: Balance
    held: int
    bounds: np.ndarray


@jit
def inside(problem, points):
    """Move points into the bounds, in place."""
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            points[row, i] = min(max(points[row, i], problem.bounds[0, i]), problem.bounds[1, i])


@jit
def differences(problem, points, values):
    """The rows r at points, shape (points, rows); the network's values stay in `values`."""
    count, size = points.shape
    inputs = first(problem.chain, values, count)
    for row in range(count):
        for i in range(size):
            inputs[row, i] = points[row, i]
    told = forward(problem.chain, values, count)
    rows = np.empty_like(told)
    times(inputs, problem.direct[:size], rows)
    for row in range(count):
        for i in range(rows.shape[1]):
            rows[row, i] += told[row, i] + problem.direct[size, i]
    return rows


@jit
def room(balance, count):
    """Room for the values of the muscles' network at so many points; none without a balance."""
    return space(balance.chain, count) if balance.weight > 0.0 else np.empty(0, balance.lines.dtype)


@jit
def muscles(balance, rows, values):
    """What the muscles lack [N m], shape (points, joints).

    Args:
        balance: Torque balance.
        rows: r at points, shape (points, rows).
        values: Room for the values of their network, which are left there.
    """
    count, joints, lines = len(rows), len(balance.joints), len(balance.lines)
    inputs = first(balance.chain, values, count)
    f, theta = balance.rows
    for row in range(count):
        for i in range(joints):
            inputs[row, i] = rows[row, theta + i] if theta >= 0 else balance.joints[i, POSTURE]
        for i in range(lines):
            inputs[row, joints + i] = rows[row, f + i]
    forward(balance.chain, values, count)
    gradient = pull_all(balance.chain, balance.back, values, force(balance, inputs))
    rest = np.empty((count, joints), rows.dtype)
    for row in range(count):
        for i in range(joints):
            rest[row, i] = balance.joints[i, TORQUE] + gradient[row, i] / balance.joints[i, STD]
            if theta >= 0:
                for j in range(joints):
                    moved = rows[row, theta + j] - balance.joints[j, POSTURE]
                    rest[row, i] += balance.joints[i, STIFFNESS + j] * moved
    return rest


@jit
def force(balance, inputs):
    """Tension f times the scale of l [N m per standard deviation of l], shape (points, muscles)."""
    joints, lines = len(balance.joints), len(balance.lines)
    found = np.empty((len(inputs), lines), inputs.dtype)
    for row in range(len(inputs)):
        for i in range(lines):
            newton = inputs[row, joints + i] * balance.lines[i, F_STD] + balance.lines[i, F_MEAN]
            found[row, i] = newton * balance.lines[i, L_STD]
    return found


@jit
def muscle_slopes(balance, values, ways):
    """How what they lack at one point changes with f and theta, seen along directions of torque.

    Args:
        balance: Torque balance.
        values: What `muscles` left of that point (`chain.alone`).
        ways: Directions, shape (k, joints).

    Returns:
        Derivatives [N m per standard deviation], shape (muscles + joints, k); those by theta stay zero where the
        posture is given.
    """
    joints, lines, count = len(balance.joints), len(balance.lines), len(ways)
    inputs = first(balance.chain, values, 1)
    tangents = np.zeros((count, inputs.shape[1]), inputs.dtype)
    for k in range(count):
        for i in range(joints):
            tangents[k, i] = ways[k, i] / balance.joints[i, STD]
    pushed, bent = mixed(balance.chain, values, force(balance, inputs), tangents)
    found = np.zeros((lines + joints, count), inputs.dtype)
    for k in range(count):
        for j in range(lines):
            scale = balance.lines[j, F_STD] * balance.lines[j, L_STD]
            found[j, k] = scale * pushed[k, j] + bent[k, joints + j]
        if balance.rows[1] >= 0:
            for j in range(joints):
                found[lines + j, k] = bent[k, j]
                for i in range(joints):
                    found[lines + j, k] += ways[k, i] * balance.joints[i, STIFFNESS + j]
    return found


@jit
def length(values, begin, end):
    """Norm of a part of a line."""
    square = 0.0
    for i in range(begin, end):
        square += values[i] * values[i]
    return np.sqrt(square)


@jit
def losses(problem, rows, breach, inner):
    """Loss of every point, shape (points,), and what its muscles lack [N m], shape (points, joints).

    Args:
        problem: What is minimised.
        rows: r at points, shape (points, rows).
        breach: What a row that must be zero and is not costs per unit.
        inner: `room` for the values of the muscles' network, which are left there.
    """
    count, width = rows.shape
    found, rest = np.zeros(count), np.empty((count, 0), rows.dtype)
    for row in range(count):
        for block in range(len(problem.weights)):
            found[row] += problem.weights[block] * length(rows[row], problem.ends[block], problem.ends[block + 1])
        for i in range(width - problem.held, width):
            found[row] += breach * abs(rows[row, i])
    if problem.balance.weight > 0.0:
        rest = muscles(problem.balance, rows, inner)
        for row in range(count):
            found[row] += problem.balance.weight * length(rest[row], 0, rest.shape[1])
    return found, rest


@jit
def gradient(problem, values, rows, inner, rest, row):
    """Gradient of the loss at one of the points by p, shape (1, n); `held` rows aside.

    Args:
        problem: What is minimised.
        values: What `differences` left.
        rows: What it returned.
        inner: What `losses` left.
        rest: What the muscles lack, of `losses`.
        row: Which point.
    """
    count, width = rows.shape
    size = len(problem.direct) - 1
    back = np.zeros((1, width), rows.dtype)
    for block in range(len(problem.weights)):
        begin, end = problem.ends[block], problem.ends[block + 1]
        share = problem.weights[block] / max(length(rows[row], begin, end), TINY)
        for i in range(begin, end):
            back[0, i] = share * rows[row, i]
    balance = problem.balance
    if balance.weight > 0.0:
        joints, lines = len(balance.joints), len(balance.lines)
        share = balance.weight / max(length(rest[row], 0, joints), TINY)
        way = rest[row : row + 1] * np.float32(share)
        slope = muscle_slopes(balance, alone(balance.chain, inner, count, row), way)
        for j in range(lines):
            back[0, balance.rows[0] + j] += slope[j, 0]
        if balance.rows[1] >= 0:
            for j in range(joints):
                back[0, balance.rows[1] + j] += slope[lines + j, 0]
    found = np.zeros((1, size), rows.dtype)
    for i in range(size):
        for j in range(width):
            found[0, i] += problem.direct[i, j] * back[0, j]
    pulled = pull(problem.chain, values, count, row, back)
    for i in range(size):
        found[0, i] += pulled[0, i]
    return found


@jit
def jacobian(problem, values, count, row):
    """Derivatives of r at one of the points by p, shape (n, rows)."""
    found = push_all(problem.chain, values, count, row)
    for i in range(found.shape[0]):
        for j in range(found.shape[1]):
            found[i, j] += problem.direct[i, j]
    return found
