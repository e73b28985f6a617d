"""The paper's descent (II-G) in one call, with many step sizes at once; `gemuco.search.descent` explains it."""

import numpy as np

from gemuco.compiled.chain import space
from gemuco.compiled.jit import jit
from gemuco.compiled.problem import differences, gradient, inside, losses, room


@jit
def descend(problem, starts, gamma_max, candidates, iterations):
    """Minimise a problem without `held` rows.

    Args:
        problem: The loss.
        starts: First points, shape (starts, n); the descent begins at the best of them.
        gamma_max: Largest step size.
        candidates: Number of step sizes that are tried at once; 1 is a constant step.
        iterations: Number of steps.

    Returns:
        The best point, shape (n,), its loss, and the loss after every iteration, shape (iterations + 1,).
    """
    size = starts.shape[1]
    points = starts.copy()
    inside(problem, points)
    gammas = np.empty(candidates)
    for i in range(candidates):
        gammas[i] = gamma_max * i / (candidates - 1) if candidates > 1 else gamma_max
    history = np.empty(iterations + 1)
    best, least = points[0].copy(), np.inf
    values, inner = space(problem.chain, len(points)), room(problem.balance, len(points))
    for iteration in range(iterations + 1):
        rows = differences(problem, points, values)
        loss, rest = losses(problem, rows, 0.0, inner)
        index = np.argmin(loss)
        history[iteration] = loss[index]
        if loss[index] < least:
            least = loss[index]
            best = points[index].copy()
        if iteration == iterations:
            break
        if iteration > 0 and candidates > 1 and index == 0:
            for i in range(candidates):
                gammas[i] /= candidates - 1
        slope = gradient(problem, values, rows, inner, rest, index)
        origin = points[index].copy()
        if iteration == 0:
            points = np.empty((candidates, size), points.dtype)
            values, inner = space(problem.chain, candidates), room(problem.balance, candidates)
        for row in range(candidates):
            for i in range(size):
                points[row, i] = origin[i] - gammas[row] * slope[0, i]
        inside(problem, points)
    return best, least, history
