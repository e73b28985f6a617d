"""Gradient descent that tries many step sizes at once (paper, II-G), and the entry to the compiled searches.

Each iteration computes the gradient at the current point, makes one candidate per step size in [0, gamma_max],
evaluates all candidates as a batch, and continues from the best one. The step size 0 is included, so the loss never
rises. If it is the best, all other steps were too long, and the next step sizes lie between 0 and the shortest of them.
With a single candidate this is gradient descent with the constant step gamma_max.

A constraint is satisfied at every candidate and has no weight: steps are tangential to it, and Newton steps correct the
remaining deviation.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gemuco.compiled import descent, newton
from gemuco.compiled.problem import Problem
from gemuco.errors import SchemaError

Objective = Callable[[np.ndarray, bool], tuple[np.ndarray, np.ndarray]]
"""An objective maps points (candidates, n) to losses (candidates,) and, if the flag is set, gradients (candidates, n).
Only the best candidate needs a gradient."""
Constraint = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""A constraint maps points (candidates, n) to values that must be zero (candidates, k) and their Jacobian
(candidates, k, n)."""

RETURNS = 3
"""After every step, this many Newton steps lead back to the constraint."""
LAST_RETURNS = 10
"""After the last step, this many Newton steps lead back to the constraint."""
BREACH = 100.0
"""A candidate that still violates the constraint gets this loss per unit, so that it is not selected."""
DAMPING = 1e-6
"""The diagonal of J J^T, which may be singular, is increased by this."""


@dataclass(frozen=True, slots=True)
class DescentConfig:
    """Settings of the gradient descent.

    Attributes:
        gamma_max: Largest step size.
        candidates: Number of step sizes tried at once (the paper's N_batch); 1 is a constant step.
        iterations: Number of steps.
    """

    gamma_max: float = 0.5
    candidates: int = 12
    iterations: int = 30

    def __post_init__(self) -> None:
        if not (np.isfinite(self.gamma_max) and self.gamma_max > 0 and self.candidates >= 1 and self.iterations >= 0):
            raise SchemaError(
                f"A descent needs gamma_max > 0, at least 1 candidate and no negative number of iterations, not "
                f"{self.gamma_max}, {self.candidates} and {self.iterations}."
            )


@dataclass(frozen=True, slots=True)
class NewtonConfig:
    """Settings of the second-order search (`gemuco.compiled.newton`).

    Attributes:
        iterations: Maximum number of steps.
        tolerance: The search ends when two successive steps each lower the loss by less than this share.
    """

    iterations: int = 30
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if not (self.iterations >= 0 and 0.0 <= self.tolerance < 1.0):
            raise SchemaError(
                f"A search needs no negative number of iterations and a tolerance from 0 to 1, not {self.iterations} "
                f"and {self.tolerance}."
            )


@dataclass(frozen=True, slots=True)
class Descent:
    """Result of a search.

    Attributes:
        point: The best point, shape (n,).
        loss: Loss of this point.
        losses: Loss at the start and after every iteration.
        is_late: Whether the deadline ended the search.
    """

    point: np.ndarray
    loss: float
    losses: tuple[float, ...]
    is_late: bool = False


def descend(
    objective: Objective,
    start: np.ndarray,
    config: DescentConfig,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
    constraint: Constraint | None = None,
) -> Descent:
    """Minimise an objective in numpy.

    Args:
        objective: Losses and gradients of points.
        start: First point, shape (n,), or several points from which the best is chosen, shape (starts, n).
        config: Step sizes and iterations.
        low: Lower bounds of a point, shape (n,); candidates outside are clipped.
        high: Upper bounds of a point, shape (n,).
        constraint: Values that must be zero.
    """
    points = np.atleast_2d(start)
    if config.candidates > 1:
        gammas = np.linspace(0.0, config.gamma_max, config.candidates, dtype=points.dtype)[:, None]
    else:
        gammas = np.full((1, 1), config.gamma_max, points.dtype)
    history: list[float] = []
    best_point, best_loss = points[0], np.inf
    for iteration in range(config.iterations + 1):
        points = _clipped(points, low, high)
        breach: np.ndarray | float = 0.0
        if constraint is not None:
            points = _to_constraint(constraint, points, RETURNS, low, high)
            deviation, jacobian = constraint(points)
            breach = BREACH * np.abs(deviation).sum(axis=1)
        losses = objective(points, False)[0] + breach
        best = int(np.argmin(losses))
        loss = float(losses[best])
        history.append(loss)
        if loss < best_loss:
            best_point, best_loss = points[best].copy(), loss
        if iteration < config.iterations:
            if iteration and config.candidates > 1 and best == 0:
                gammas = gammas / np.float32(config.candidates - 1)
            gradient = objective(points[best : best + 1], True)[1][0]
            if constraint is not None:
                gradient = gradient - _shortest_step(jacobian[best : best + 1], jacobian[best : best + 1] @ gradient)[0]
            points = points[best] - gammas * gradient
    if constraint is not None:
        last = _to_constraint(constraint, best_point[None], LAST_RETURNS, low, high)
        best_point, best_loss = last[0], float(objective(last, False)[0][0])
    return Descent(best_point, best_loss, tuple(history))


def minimise(
    problem: Problem, starts: np.ndarray, config: DescentConfig | NewtonConfig, until: float = math.inf
) -> Descent:
    """Minimise a folded problem in one compiled call.

    Args:
        problem: From `gemuco.search.fold`.
        starts: First points, shape (starts, n) or (n,).
        config: Settings; their class selects the search.
        until: Deadline of a second-order search [s of `time.monotonic`].
    """
    points = np.ascontiguousarray(np.atleast_2d(starts), problem.direct.dtype)
    if isinstance(config, DescentConfig):
        point, loss, history = descent.descend(
            problem, points, float(config.gamma_max), config.candidates, config.iterations
        )
        return Descent(point, float(loss), tuple(history))
    result = newton.search(problem, points, config.iterations, float(config.tolerance), float(until))
    point, loss, history, is_late = result
    return Descent(point, float(loss), tuple(history), bool(is_late))


def _clipped(points: np.ndarray, low: np.ndarray | None, high: np.ndarray | None) -> np.ndarray:
    return points if low is None and high is None else np.clip(points, low, high)


def _to_constraint(
    constraint: Constraint, points: np.ndarray, steps: int, low: np.ndarray | None, high: np.ndarray | None
) -> np.ndarray:
    """Take the shortest Newton steps towards the constraint."""
    for _ in range(steps):
        deviation, jacobian = constraint(points)
        points = _clipped(points - _shortest_step(jacobian, deviation), low, high)
    return points


def _shortest_step(jacobian: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the shortest step that changes the constraint as given: J^T (J J^T)^-1 change, shape (candidates, n)."""
    square = jacobian @ jacobian.transpose(0, 2, 1)
    square = square + DAMPING * np.eye(square.shape[1], dtype=square.dtype)
    step = jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, change[:, :, None])
    return step[:, :, 0].astype(jacobian.dtype)
