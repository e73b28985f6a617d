"""The humanoid in its experiments, and its designer's models."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from hal import registry
from hal.config import RobotConfig
from services.learning.motion import Forecast
from services.model.model_config import collect_config
from studies.paper.body import JOINTS, Body

CENTER, TIP, PIXEL = "center_of_gravity", "tool_tip_position", "tool_tip_pixel"
ARRIVED = 1e-5
"""Joint travel per step [rad] below which the servos stand."""
EASY = np.array([0.010, 0.015])
"""Largest offset of the center of gravity from the middle of the feet [m] at which a tip is a target."""
TIP_SCALE, CENTER_SCALE = 0.001, 0.020
"""Errors of tip and center of gravity [m] that count the same in inverse kinematics."""
ROUNDS, SLOPE = 60, 1e-5

Model = Callable[[np.ndarray], Mapping[str, np.ndarray]]
"""A model maps commands [rad], shape (n, 4), to signals, shapes (n, size)."""


class Standing(Body):
    """The simulated humanoid."""

    def __init__(self, robot: RobotConfig, variant: str, seed: int, condition: str) -> None:
        super().__init__(robot, variant, seed, condition, ARRIVED)


def designed(robot: RobotConfig, condition: str) -> Model:
    """Return the designer's model with its deflection: the robot file's `collect.forecast`."""
    model: Model = partial(registry.load_object(str(collect_config(robot).forecast)), robot, condition)
    return model


def stiff(robot: RobotConfig, condition: str) -> Model:
    """Return the designer's geometry without deflection."""
    model: Model = partial(registry.load_object(str(robot.simulator), "simulator", ("geometric",)).geometric, condition)
    return model


def safe_postures(robot: RobotConfig, condition: str, count: int, random: np.random.Generator) -> np.ndarray:
    """Draw commands [rad], shape (count, 4), that keep the constraints by the designer's model."""
    forecast = Forecast(robot, collect_config(robot), condition)
    safe = np.zeros((0, 4))
    while len(safe) < count:
        drawn = random.uniform(*robot.bounds(JOINTS), (16 * count, 4))
        safe = np.concatenate([safe, drawn[~forecast.outside(drawn).any(axis=1)]])
    return safe[:count]


def random_targets(robot: RobotConfig, condition: str, count: int, random: np.random.Generator) -> np.ndarray:
    """Draw tips [m], shape (count, 3), that the designer's robot reaches in balance with a tool."""
    model = designed(robot, condition)
    targets = np.zeros((0, 3))
    while len(targets) < count:
        forecast = model(safe_postures(robot, condition, 4 * count, random))
        is_easy = np.all(np.abs(forecast[CENTER]) < EASY, axis=1)
        targets = np.concatenate([targets, forecast[TIP][is_easy]])
    return targets[:count]


def inverse(robot: RobotConfig, model: Model, targets: np.ndarray) -> np.ndarray:
    """Return commands [rad], shape (n, 4), that bring the tip to targets [m], shape (n, 3), in balance.

    Gauss-Newton with damping on a model, from several postures; the best solution is kept.
    """
    low, high = robot.bounds(JOINTS)
    starts = low + (high - low) * np.random.default_rng(0).uniform(0.2, 0.8, (6, 4))
    best, least = np.zeros((len(targets), 4)), np.full(len(targets), np.inf)
    for start in starts:
        command = np.repeat(start[None], len(targets), axis=0)
        damping = np.full(len(targets), 1.0)
        residual = _residual(model, command, targets)
        for _ in range(ROUNDS):
            slopes = np.stack(
                [(_residual(model, command + SLOPE * axis, targets) - residual) / SLOPE for axis in np.eye(4)], axis=2
            )
            curvature = np.einsum("nij,nik->njk", slopes, slopes) + damping[:, None, None] * np.eye(4)
            step = np.linalg.solve(curvature, -np.einsum("nij,ni->nj", slopes, residual)[..., None])[..., 0]
            tried = np.clip(command + step, low, high)
            after = _residual(model, tried, targets)
            better = np.sum(after**2, axis=1) < np.sum(residual**2, axis=1)
            command = np.where(better[:, None], tried, command)
            residual = np.where(better[:, None], after, residual)
            damping = np.where(better, 0.3 * damping, 4.0 * damping).clip(1e-3, 1e9)
        cost = np.sum(residual**2, axis=1)
        best = np.where((cost < least)[:, None], command, best)
        least = np.minimum(cost, least)
    return best


def _residual(model: Model, command: np.ndarray, targets: np.ndarray) -> np.ndarray:
    forecast = model(command)
    return np.concatenate([(forecast[TIP] - targets) / TIP_SCALE, forecast[CENTER] / CENTER_SCALE], axis=1)
