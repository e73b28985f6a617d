"""The one optimiser (paper, II-F): gradient descent that tries many step sizes at once.

It knows no loss and no robot. From the present point it takes the gradient, makes one candidate per step size in
[0, gamma_max], evaluates all of them as a batch, and goes on from the best. Because the step size 0 is among them the
loss never rises; where it wins, every other step was too long, and the next ones are spread between 0 and the shortest
of them. A single candidate is plain descent with the constant step gamma_max.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Objective = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Points (candidates, n) -> losses (candidates,) and their gradients (candidates, n)."""


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


@dataclass(frozen=True, slots=True)
class Descent:
    """Where a descent ended.

    Attributes:
        point: The best point, shape (n,).
        loss: Its loss.
        losses: Loss at the start and after every iteration.
    """

    point: np.ndarray
    loss: float
    losses: tuple[float, ...]


def descend(
    objective: Objective,
    start: np.ndarray,
    config: DescentConfig,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
) -> Descent:
    """Minimise an objective.

    Args:
        objective: Losses and gradients of a batch of points.
        start: First point, shape (n,), or several to begin from the best of, shape (starts, n).
        config: Step sizes and iterations.
        low: Lower bounds of a point, shape (n,); candidates are moved inside.
        high: Upper bounds of a point, shape (n,).
    """
    points = np.atleast_2d(start)
    if config.candidates > 1:
        gammas = np.linspace(0.0, config.gamma_max, config.candidates, dtype=points.dtype)[:, None]
    else:
        gammas = np.full((1, 1), config.gamma_max, points.dtype)
    history: list[float] = []
    best_point, best_loss = points[0], np.inf
    for iteration in range(config.iterations + 1):
        if low is not None or high is not None:
            points = np.clip(points, low, high)
        losses, gradients = objective(points)
        chosen = int(np.argmin(losses))
        loss = float(losses[chosen])
        history.append(loss)
        if loss < best_loss:
            best_point, best_loss = points[chosen].copy(), loss
        if iteration < config.iterations:
            if iteration and config.candidates > 1 and chosen == 0:
                gammas = gammas / np.float32(config.candidates - 1)
            points = points[chosen] - gammas * gradients[chosen]
    return Descent(best_point, best_loss, tuple(history))
