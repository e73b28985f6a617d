"""The door to the compiled searches."""

import math

import numpy as np

from gemuco.compiled import descent, newton
from gemuco.compiled.problem import Problem
from gemuco.search.descent import Descent, DescentConfig, NewtonConfig


def minimise(
    problem: Problem, starts: np.ndarray, config: DescentConfig | NewtonConfig, until: float = math.inf
) -> Descent:
    """Minimise a folded problem, in one call that needs no interpreter.

    Args:
        problem: From `gemuco.search.fold`.
        starts: First points, shape (starts, n) or (n,).
        config: Which search, and how far.
        until: When a second-order search ends at the latest [s of `time.monotonic`].
    """
    points = np.ascontiguousarray(np.atleast_2d(starts), problem.direct.dtype)
    if isinstance(config, DescentConfig):
        point, loss, history = descent.descend(
            problem, points, float(config.gamma_max), config.candidates, config.iterations
        )
        return Descent(point, float(loss), tuple(history))
    found = newton.search(problem, points, config.iterations, float(config.tolerance), float(until))
    point, loss, history, is_late = found
    return Descent(point, float(loss), tuple(history), bool(is_late))
