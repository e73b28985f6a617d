"""Loss of a search for compiled code: a sum of norms of differences that a network predicts.

The terms of a loss are linear in the prediction, so they are merged with the network: the inputs of its first layer are
only the searched numbers p, and the outputs of its last layer are the differences, r(p) = D p + c + net(p). The loss is

    loss(p) = sum_k weight_k ||r_k(p)|| + weight ||torque + K (theta - theta_0) + G(theta, f)^T f||

with blocks r_k of r. Further rows of r are f, in simulation theta, and the values that must be zero.
"""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.blas import times
from gemuco.compiled.chain import Packed, alone, first, forward, mixed, pull, pull_all, push_all, space
from gemuco.compiled.jit import jit

TINY = 1e-9


class Balance(NamedTuple):
    """Torque balance of muscles (`gemuco.search.torque`); unused if `weight` is 0.

    Attributes:
        chain: Network from posture, followed by tension, to muscle length.
        back: Transposed matrices of the network, see `chain.turned`.
        joints: For every joint: theta's standard deviation [rad], tau_ext at theta_0 [N m], theta_0 [standard
            deviations], and the stiffness K [N m per standard deviation], shape (joints, 3 + joints).
        lines: For every muscle: f's standard deviation and mean [N], l's standard deviation [m], shape (muscles, 3).
        rows: First row of f and of theta in r; -1 if theta is given and equals theta_0.
        weight: Loss per N m.
    """

    chain: Packed
    back: np.ndarray
    joints: np.ndarray
    lines: np.ndarray
    rows: tuple[int, int]
    weight: float


STD, TORQUE, POSTURE, STIFFNESS = range(4)
"""These are the columns of `Balance.joints`."""
F_STD, F_MEAN, L_STD = range(3)
"""These are the columns of `Balance.lines`."""


class Problem(NamedTuple):
    """A loss of n numbers p.

    Attributes:
        chain: The network net(p), from n inputs to the rows of r.
        direct: D with c as its last row, shape (n + 1, rows).
        ends: Borders of the blocks, shape (blocks + 1,), beginning with 0.
        weights: Weights of the blocks, shape (blocks,).
        balance: Torque balance.
        held: Number of rows at the end that must be zero.
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
    """Return the rows r at points, shape (points, rows), and keep the network's values in `values`."""
    count, size = points.shape
    inputs = first(problem.chain, values, count)
    for row in range(count):
        for i in range(size):
            inputs[row, i] = points[row, i]
    prediction = forward(problem.chain, values, count)
    rows = np.empty_like(prediction)
    times(inputs, problem.direct[:size], rows)
    for row in range(count):
        for i in range(rows.shape[1]):
            rows[row, i] += prediction[row, i] + problem.direct[size, i]
    return rows


@jit
def room(balance, count):
    """Allocate memory for the values of the muscles' network at `count` points; it is empty without a balance."""
    return space(balance.chain, count) if balance.weight > 0.0 else np.empty(0, balance.lines.dtype)


@jit
def muscles(balance, rows, values):
    """Return the missing torque of the muscles [N m], shape (points, joints).

    Args:
        balance: Torque balance.
        rows: r at points, shape (points, rows).
        values: Memory for the values of the muscles' network, which stay there.
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
    """Return tension f times the scale of l [N m per standard deviation of l], shape (points, muscles)."""
    joints, lines = len(balance.joints), len(balance.lines)
    scaled = np.empty((len(inputs), lines), inputs.dtype)
    for row in range(len(inputs)):
        for i in range(lines):
            newton = inputs[row, joints + i] * balance.lines[i, F_STD] + balance.lines[i, F_MEAN]
            scaled[row, i] = newton * balance.lines[i, L_STD]
    return scaled


@jit
def muscle_slopes(balance, values, ways):
    """Return the derivatives of the missing torque at one point by f and theta, along directions of torque.

    Args:
        balance: Torque balance.
        values: Values of `muscles` at this point (`chain.alone`).
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
    slopes = np.zeros((lines + joints, count), inputs.dtype)
    for k in range(count):
        for j in range(lines):
            scale = balance.lines[j, F_STD] * balance.lines[j, L_STD]
            slopes[j, k] = scale * pushed[k, j] + bent[k, joints + j]
        if balance.rows[1] >= 0:
            for j in range(joints):
                slopes[lines + j, k] = bent[k, j]
                for i in range(joints):
                    slopes[lines + j, k] += ways[k, i] * balance.joints[i, STIFFNESS + j]
    return slopes


@jit
def length(values, begin, end):
    """Return the norm of a part of a row."""
    square = 0.0
    for i in range(begin, end):
        square += values[i] * values[i]
    return np.sqrt(square)


@jit
def losses(problem, rows, breach, inner):
    """Return the loss of every point, shape (points,), and the missing torque there [N m], shape (points, joints).

    Args:
        problem: The loss.
        rows: r at points, shape (points, rows).
        breach: Loss per unit of a row that must be zero.
        inner: Memory for the values of the muscles' network (`room`), which stay there.
    """
    count, width = rows.shape
    loss, rest = np.zeros(count), np.empty((count, 0), rows.dtype)
    for row in range(count):
        for block in range(len(problem.weights)):
            loss[row] += problem.weights[block] * length(rows[row], problem.ends[block], problem.ends[block + 1])
        for i in range(width - problem.held, width):
            loss[row] += breach * abs(rows[row, i])
    if problem.balance.weight > 0.0:
        rest = muscles(problem.balance, rows, inner)
        for row in range(count):
            loss[row] += problem.balance.weight * length(rest[row], 0, rest.shape[1])
    return loss, rest


@jit
def gradient(problem, values, rows, inner, rest, row):
    """Return the gradient of the loss by p at one point, shape (1, n), without the `held` rows.

    Args:
        problem: The loss.
        values: Values of the network after `differences`.
        rows: Result of `differences`.
        inner: Values of the muscles' network after `losses`.
        rest: Missing torque, from `losses`.
        row: Index of the point.
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
    total = np.zeros((1, size), rows.dtype)
    for i in range(size):
        for j in range(width):
            total[0, i] += problem.direct[i, j] * back[0, j]
    pulled = pull(problem.chain, values, count, row, back)
    for i in range(size):
        total[0, i] += pulled[0, i]
    return total


@jit
def jacobian(problem, values, count, row):
    """Return the derivatives of r by p at one point, shape (n, rows)."""
    slopes = push_all(problem.chain, values, count, row)
    for i in range(slopes.shape[0]):
        for j in range(slopes.shape[1]):
            slopes[i, j] += problem.direct[i, j]
    return slopes
