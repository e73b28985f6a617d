"""The humanoid in its experiments: moved posture by posture, and what its designer's models say of it."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from hal import registry
from hal.config import RobotConfig
from services.learning.motion import Forecast
from services.model.model_config import collect_config

JOINTS, CENTER, TIP, PIXEL = "joint_position", "center_of_gravity", "tool_tip_position", "tool_tip_pixel"
TICK = 0.02
"""Step of the simulated robot [s]."""
ARRIVED = 1e-5
"""Joint travel per step [rad] below which the servos stand."""
EASY = np.array([0.010, 0.015])
"""Targets are tips that can be reached with the center of gravity so near the middle of the feet [m]."""
TIP_SCALE, CENTER_SCALE = 0.001, 0.020
"""In inverse kinematics a millimetre of the tip counts as much as 20 mm of the center of gravity."""
ROUNDS, SLOPE = 60, 1e-5

Model = Callable[[np.ndarray], Mapping[str, np.ndarray]]
"""Commands [rad], shape (n, 4), to signals, shapes (n, size)."""


class Standing:
    """The simulated humanoid; not thread-safe."""

    def __init__(self, robot: RobotConfig, variant: str, seed: int, condition: str) -> None:
        self._world: Any = registry.load(str(robot.simulator)).world(variant, seed, condition)
        self._low, self._high = robot.bounds(JOINTS)
        self._elements = [f"{JOINTS}.{name}" for name in robot.signals[JOINTS].elements]

    def go(self, command: np.ndarray) -> Mapping[str, np.ndarray]:
        """Move to a posture [rad], shape (4,), within the robot file's limits; what is measured at rest there."""
        for element, angle in zip(self._elements, np.clip(command, self._low, self._high).tolist(), strict=True):
            self._world.drive(element, angle, True)
        before = np.full(len(command), np.inf)
        while np.abs((now := self._world.truth()[JOINTS]) - before).max() > ARRIVED:
            before = now
            self._world.step(TICK)
        measured: Mapping[str, np.ndarray] = self._world.measure()
        return {name: measured[name] for name in (JOINTS, CENTER, TIP, PIXEL)}

    def truth(self, signal: str) -> np.ndarray:
        """A signal as it is, seen by the camera or not [its unit]."""
        found: np.ndarray = self._world.truth()[signal]
        return found

    def hold(self, condition: str) -> None:
        """Put another tool into the hand."""
        self._world.break_part(f"tool_changed:{condition}")


def designed(robot: RobotConfig, condition: str) -> Model:
    """The designer's model with its deflection: the robot file's `collect.forecast`."""
    model: Model = partial(registry.load(str(collect_config(robot).forecast)), robot, condition)
    return model


def stiff(robot: RobotConfig, condition: str) -> Model:
    """The designer's geometry without any deflection."""
    model: Model = partial(registry.load(str(robot.simulator)).geometric, condition)
    return model


def safe_postures(robot: RobotConfig, condition: str, count: int, random: np.random.Generator) -> np.ndarray:
    """Random commands [rad], shape (count, 4), that the designer's model says keep the robot file's constraints."""
    forecast = Forecast(robot, collect_config(robot), condition)
    found = np.zeros((0, 4))
    while len(found) < count:
        drawn = random.uniform(*robot.bounds(JOINTS), (16 * count, 4))
        found = np.concatenate([found, drawn[~forecast.outside(drawn).any(axis=1)]])
    return found[:count]


def random_targets(robot: RobotConfig, condition: str, count: int, random: np.random.Generator) -> np.ndarray:
    """Tips [m], shape (count, 3), that the designer's robot can reach in balance with a tool."""
    model = designed(robot, condition)
    found = np.zeros((0, 3))
    while len(found) < count:
        told = model(safe_postures(robot, condition, 4 * count, random))
        easy = np.all(np.abs(told[CENTER]) < EASY, axis=1)
        found = np.concatenate([found, told[TIP][easy]])
    return found[:count]


def inverse(robot: RobotConfig, model: Model, targets: np.ndarray) -> np.ndarray:
    """Commands [rad], shape (n, 4), that bring the tip to targets [m], shape (n, 3), and the center of gravity near 0.

    Gauss-Newton with damping by a model, from several postures; the best is kept.
    """
    low, high = robot.bounds(JOINTS)
    starts = low + (high - low) * np.random.default_rng(0).uniform(0.2, 0.8, (6, 4))
    found, least = np.zeros((len(targets), 4)), np.full(len(targets), np.inf)
    for start in starts:
        command = np.repeat(start[None], len(targets), axis=0)
        damping = np.full(len(targets), 1.0)
        left = _left(model, command, targets)
        for _ in range(ROUNDS):
            slopes = np.stack(
                [(_left(model, command + SLOPE * one, targets) - left) / SLOPE for one in np.eye(4)], axis=2
            )
            curvature = np.einsum("nij,nik->njk", slopes, slopes) + damping[:, None, None] * np.eye(4)
            step = np.linalg.solve(curvature, -np.einsum("nij,ni->nj", slopes, left)[..., None])[..., 0]
            tried = np.clip(command + step, low, high)
            after = _left(model, tried, targets)
            better = np.sum(after**2, axis=1) < np.sum(left**2, axis=1)
            command, left = np.where(better[:, None], tried, command), np.where(better[:, None], after, left)
            damping = np.where(better, 0.3 * damping, 4.0 * damping).clip(1e-3, 1e9)
        cost = np.sum(left**2, axis=1)
        found = np.where((cost < least)[:, None], command, found)
        least = np.minimum(cost, least)
    return found


def _left(model: Model, command: np.ndarray, targets: np.ndarray) -> np.ndarray:
    told = model(command)
    return np.concatenate([(told[TIP] - targets) / TIP_SCALE, told[CENTER] / CENTER_SCALE], axis=1)
