"""The one optimiser (paper, II-G): gradient descent that tries many step sizes at once.

It knows no loss and no robot. From the present point it takes the gradient, makes one candidate per step size in
[0, gamma_max], evaluates all of them as a batch, and goes on from the best. Because the step size 0 is among them the
loss never rises; where it wins, every other step was too long, and the next ones are spread between 0 and the shortest
of them. A single candidate is plain descent with the constant step gamma_max.

A constraint is met at every candidate, not weighed against the loss: steps go along it, and what the steps bend away
from it Newton steps bring back.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gemuco.compiled import descent, newton
from gemuco.compiled.problem import Problem
from gemuco.errors import SchemaError

Objective = Callable[[np.ndarray, bool], tuple[np.ndarray, np.ndarray]]
"""Points (candidates, n) -> losses (candidates,) and, if wanted, gradients (candidates, n). Of all candidates only
the best needs one, so the many are evaluated without."""
Constraint = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Points (candidates, n) -> what must be zero (candidates, k) and its Jacobian (candidates, k, n)."""

RETURNS = 3
"""Newton steps back to the constraint after every step."""
LAST_RETURNS = 10
"""And after the last one."""
BREACH = 100.0
"""Loss per unit of a constraint that is not met after all: a candidate that could not be brought back does not win."""
DAMPING = 1e-6


@dataclass(frozen=True, slots=True)
class DescentConfig:
    """How far and how often.

    Attributes:
        gamma_max: Largest step size.
        candidates: How many step sizes are tried at once (the paper's N_batch); 1 is a constant step.
        iterations: How many steps.
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
    """How far the second-order search goes (`gemuco.compiled.newton`).

    Attributes:
        iterations: At most so many steps.
        tolerance: It ends when two steps in a row lower the loss by less than this share of it.
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
    """Where a descent ended.

    Attributes:
        point: The best point, shape (n,).
        loss: Its loss.
        losses: Loss at the start and after every iteration.
        is_late: Whether time was up before the end.
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
    """Minimise an objective.

    Args:
        objective: Losses and gradients of points.
        start: First point, shape (n,), or several to begin from the best of, shape (starts, n).
        config: Step sizes and iterations.
        low: Lower bounds of a point, shape (n,); candidates are moved inside.
        high: Upper bounds of a point, shape (n,).
        constraint: What must be zero.
    """
    points = np.atleast_2d(start)
    if config.candidates > 1:
        gammas = np.linspace(0.0, config.gamma_max, config.candidates, dtype=points.dtype)[:, None]
    else:
        gammas = np.full((1, 1), config.gamma_max, points.dtype)
    history: list[float] = []
    best_point, best_loss = points[0], np.inf
    for iteration in range(config.iterations + 1):
        points = _inside(points, low, high)
        breach: np.ndarray | float = 0.0
        if constraint is not None:
            points = _back(constraint, points, RETURNS, low, high)
            amiss, jacobian = constraint(points)
            breach = BREACH * np.abs(amiss).sum(axis=1)
        losses = objective(points, False)[0] + breach
        chosen = int(np.argmin(losses))
        loss = float(losses[chosen])
        history.append(loss)
        if loss < best_loss:
            best_point, best_loss = points[chosen].copy(), loss
        if iteration < config.iterations:
            if iteration and config.candidates > 1 and chosen == 0:
                gammas = gammas / np.float32(config.candidates - 1)
            gradient = objective(points[chosen : chosen + 1], True)[1][0]
            if constraint is not None:
                gradient = gradient - _least(jacobian[chosen : chosen + 1], jacobian[chosen : chosen + 1] @ gradient)[0]
            points = points[chosen] - gammas * gradient
    if constraint is not None:
        last = _back(constraint, best_point[None], LAST_RETURNS, low, high)
        best_point, best_loss = last[0], float(objective(last, False)[0][0])
    return Descent(best_point, best_loss, tuple(history))


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


def _inside(points: np.ndarray, low: np.ndarray | None, high: np.ndarray | None) -> np.ndarray:
    return points if low is None and high is None else np.clip(points, low, high)


def _back(
    constraint: Constraint, points: np.ndarray, steps: int, low: np.ndarray | None, high: np.ndarray | None
) -> np.ndarray:
    """Newton steps of least length towards the constraint."""
    for _ in range(steps):
        amiss, jacobian = constraint(points)
        points = _inside(points - _least(jacobian, amiss), low, high)
    return points


def _least(jacobian: np.ndarray, amiss: np.ndarray) -> np.ndarray:
    """The shortest step that changes the constraint by so much: J^T (J J^T)^-1 amiss, shape (candidates, n)."""
    square = jacobian @ jacobian.transpose(0, 2, 1)
    square = square + DAMPING * np.eye(square.shape[1], dtype=square.dtype)
    step = jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, amiss[:, :, None])
    return step[:, :, 0].astype(jacobian.dtype)
