"""The paper's descent (II-G) in one call: many step sizes at once; see `gemuco.search.descent`, which says more."""

import numpy as np

from gemuco.compiled.chain import space
from gemuco.compiled.jit import jit
from gemuco.compiled.problem import differences, gradient, inside, losses, room


@jit
def descend(problem, starts, gamma_max, candidates, iterations):
    """Minimise a problem without `held` rows.

    Args:
        problem: What.
        starts: First points, shape (starts, n); the best of them is where it begins.
        gamma_max: Largest step size.
        candidates: How many step sizes are tried at once; 1 is a constant step.
        iterations: How many steps.

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
        found, rest = losses(problem, rows, 0.0, inner)
        chosen = np.argmin(found)
        history[iteration] = found[chosen]
        if found[chosen] < least:
            least = found[chosen]
            best = points[chosen].copy()
        if iteration == iterations:
            break
        if iteration > 0 and candidates > 1 and chosen == 0:
            for i in range(candidates):
                gammas[i] /= candidates - 1
        slope = gradient(problem, values, rows, inner, rest, chosen)
        origin = points[chosen].copy()
        if iteration == 0:
            points = np.empty((candidates, size), points.dtype)
            values, inner = space(problem.chain, candidates), room(problem.balance, candidates)
        for row in range(candidates):
            for i in range(size):
                points[row, i] = origin[i] - gammas[row] * slope[0, i]
        inside(problem, points)
    return best, least, history
