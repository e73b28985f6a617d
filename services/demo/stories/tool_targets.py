"""Targets that a robot reaches with both of two tools, by its designer's model."""

import numpy as np

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from services.learning.motion import Forecast, NowhereToGo
from services.model.model_config import collect_config

DRAWN = 30_000
"""This many random postures are drawn per tool."""
INSIDE = 0.1
"""The distance of postures from the limits is at least this share of the range."""
TRIED = 3000
"""At most this many postures are tried as a target."""
STARTS = 10
"""Targets are drawn from at most this many first ones: not every one has enough others near it."""
CLOSE = 0.02
"""A posture with the other tool must reach a target with at most this error [unit of the target]."""
APART = (0.08, 0.25)
"""The distance of a target from the next is at least and at most this [unit of the target]."""


def common_targets(
    robot: RobotConfig, signal: str, conditions: tuple[str, str], count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Draw targets that random postures reach under both conditions, each within limits and constraints.

    Args:
        robot: The robot file, whose `collect` section has a forecast of the signal.
        signal: Signal of the targets.
        conditions: Two of the robot's conditions.
        count: Number of targets.
        seed: Seed of the draws.

    Returns:
        Targets [unit of the signal], shape (count, n), each near the previous target; and the postures that reach them
        under the first condition [unit of the commanded signal], shape (count, k).

    Raises:
        ConfigError: The robot file has no forecast of the signal.
        NowhereToGo: There are fewer targets than `count`.
    """
    random = np.random.default_rng(seed)
    (postures, first), (_, second) = (_reached(robot, signal, condition, random) for condition in conditions)
    most = 0
    for _ in range(STARTS):
        order = random.permutation(len(first))[:TRIED]
        chosen: list[int] = []
        while len(chosen) < count and (index := _next(order, first, second, chosen)) is not None:
            chosen.append(index)
        if len(chosen) == count:
            return first[chosen], postures[chosen]
        most = max(most, len(chosen))
    raise NowhereToGo(
        f"Only {most} of {count} targets near one another are reached with both tools, by the forecast of the robot "
        "file's 'collect' section. Widen collect.constraints, or order `conditions` so that the first and the last "
        "reach the same places."
    )


def _next(order: np.ndarray, first: np.ndarray, second: np.ndarray, chosen: list[int]) -> int | None:
    """Return the first index in `order` that is new, near the last chosen target, and reached by both tools, if any."""
    least, largest = APART
    for index in order:
        away = np.linalg.norm(first[chosen] - first[index], axis=1)
        if chosen and (away.min() < least or away[-1] > largest):
            continue
        if len(second) and np.linalg.norm(second - first[index], axis=1).min() <= CLOSE:
            return int(index)
    return None


def _reached(
    robot: RobotConfig, signal: str, condition: str, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return random postures allowed under a condition, shape (m, k), and the targets they reach, shape (m, n)."""
    config = collect_config(robot)
    if config.forecast is None:
        raise ConfigError(f"Robot '{robot.robot}' has no collect.forecast, so its reachable targets are not known.")
    low, high = robot.bounds(robot.command.signal)
    margin = INSIDE * (high - low)
    postures = random.uniform(low + margin, high - margin, (DRAWN, low.size))
    postures = postures[~Forecast(robot, config, condition).outside(postures).any(axis=1)]
    forecast = registry.load_object(config.forecast)(robot, condition, postures)
    if signal not in forecast:
        raise ConfigError(f"{config.forecast} forecasts {', '.join(forecast)}; the targets are of {signal}.")
    return postures, np.asarray(forecast[signal], float)
