"""How a robot is moved while it is recorded: random postures, safe by the designer's model, and the ways between."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from services.errors import ServiceError
from services.model.model_config import CollectConfig

STEP = 0.02
"""Time between set-points on the way [s], or the HAL's period if that is longer."""
PEAK = 1.875
"""Highest speed of a minimum-jerk move, in units of its mean speed."""
SHORTEST = 0.1
"""Least duration of a move [s]."""
CHECKS = 24
"""Points of a way of which a forecast is made, besides its end."""
BATCH = 64
"""Random postures that are drawn and forecast together."""
TRIES = 200
"""Batches, and ways, that are tried before it is said that nothing fits."""

Move = tuple[np.ndarray, float]
"""A command [unit of the commanded signal], shape (k,), and how long it is to be given [s]."""
Motion = Callable[[np.ndarray], Iterator[Move]]
"""From where the robot is, shape (k,), to the moves."""


class NowhereToGo(ServiceError):
    """No random posture, or no way to one, keeps the constraints; the text says which are in the way."""


class Forecast:
    """The designer's word on where a command leads, held against the constraints of the `collect` section."""

    def __init__(self, robot: RobotConfig, config: CollectConfig, condition: str | None) -> None:
        """Load the model.

        Raises:
            ConfigError: There is no such model, or it does not tell what is constrained.
        """
        self._signals = tuple(config.constraints)
        self._bounds: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        if not self._signals:
            return
        name = str(config.forecast)
        self._model = partial(registry.load(name), robot, condition)
        low, _ = robot.bounds(robot.command.signal)
        found = self._model(np.zeros((1, low.size)))
        for signal in self._signals:
            size = robot.signals[signal].size
            if signal not in found or np.shape(found[signal]) != (1, size):
                raise ConfigError(
                    f"{name} forecasts {_shapes(found)}; collect.constraints need {signal} of shape (1, {size}) "
                    "for one command."
                )
            self._bounds[signal] = config.constraints[signal].bounds(size, f"constraints.{signal}")

    def outside(self, commands: np.ndarray, no_worse_than: np.ndarray | None = None) -> np.ndarray:
        """Which constraints commands violate; what cannot be forecast violates.

        Args:
            commands: Shape (n, k).
            no_worse_than: A command, shape (k,), whose own violation is forgiven.

        Returns:
            Truth values, shape (n, constraints).
        """
        violated = np.zeros((len(commands), len(self._signals)), bool)
        if not self._signals:
            return violated
        found = self._model(commands)
        forgiven = {} if no_worse_than is None else self._model(no_worse_than[None])
        for index, signal in enumerate(self._signals):
            low, high = self._bounds[signal]
            inside = (found[signal] >= low) & (found[signal] <= high)
            if signal in forgiven:
                there = forgiven[signal][0]
                between = (found[signal] >= np.minimum(low, there)) & (found[signal] <= np.maximum(high, there))
                inside = between | np.isnan(there)
            violated[:, index] = ~inside.all(axis=1)
        return violated

    def blame(self, violated: np.ndarray) -> str:
        """Which constraints refused which share of what was tried, shape (n, constraints)."""
        shares = violated.mean(axis=0)
        return ", ".join(f"{signal} refused {share:.0%}" for signal, share in zip(self._signals, shares, strict=True))


def way(start: np.ndarray, goal: np.ndarray, speed: float, step: float) -> np.ndarray:
    """Set-points of a minimum-jerk move every `step` [s], the last one being the goal, shape (n, k).

    Args:
        start: Shape (k,).
        goal: Shape (k,).
        speed: Highest speed of an element [unit/s].
        step: Time between set-points [s].
    """
    duration = max(SHORTEST, PEAK * float(np.abs(goal - start).max()) / speed)
    count = max(1, int(np.ceil(duration / step)))
    return start + np.outer(_smooth(np.arange(1, count + 1) / count), goal - start)


def random_postures(robot: RobotConfig, config: CollectConfig, condition: str | None, seed: int) -> Motion:
    """Random postures within the limits of the commanded signal, held for a moment, and smooth moves between them.

    Every posture, and the way there, is forecast to keep the constraints; only on the first way, from a start that
    does not, as much as there is forgiven.

    Raises:
        ConfigError: The commanded signal has no limits, or the forecast does not fit the constraints.
    """
    low, high = robot.bounds(robot.command.signal)
    if not np.isfinite(high - low).all():
        raise ConfigError(
            f"Robot '{robot.robot}' needs limits.{robot.command.signal} with low and high for every element: random "
            "postures are drawn between them."
        )
    forecast = Forecast(robot, config, condition)
    speed, step = speed_of(robot, config), step_of(robot)

    def moves(start: np.ndarray) -> Iterator[Move]:
        random = np.random.default_rng([seed, *(condition or "").encode()])
        forgiven: np.ndarray | None = start
        while True:
            goal = _next_posture(forecast, random, (low, high), start, forgiven)
            yield from ((point, step) for point in way(start, goal, speed, step))
            if config.hold:
                yield goal, config.hold
            start, forgiven = goal, None

    return moves


def _next_posture(
    forecast: Forecast,
    random: np.random.Generator,
    limits: tuple[np.ndarray, np.ndarray],
    start: np.ndarray,
    forgiven: np.ndarray | None,
) -> np.ndarray:
    """A posture, shape (k,), that keeps the constraints, as does the straight way to it."""
    shares = np.arange(1, CHECKS + 1)[:, None] / (CHECKS + 1)
    drawn, ways = [], []
    for _ in range(TRIES):
        goals = random.uniform(*limits, (BATCH, start.size))
        outside = forecast.outside(goals)
        drawn.append(outside)
        for goal in goals[~outside.any(axis=1)]:
            ways.append(forecast.outside(start + shares * (goal - start), forgiven))
            if not ways[-1].any():
                return goal
            if len(ways) >= TRIES:
                break
        if len(ways) >= TRIES:
            break
    advice = "Widen collect.constraints, or narrow the limits of the commanded signal to where they hold."
    if not ways:
        told = forecast.blame(np.concatenate(drawn))
        raise NowhereToGo(f"None of {TRIES * BATCH} random postures keeps the constraints: {told}. {advice}")
    told = forecast.blame(np.array([part.any(axis=0) for part in ways]))
    raise NowhereToGo(f"From where the robot is, none of {len(ways)} ways keeps the constraints: {told}. {advice}")


def speed_of(robot: RobotConfig, config: CollectConfig) -> float:
    """Highest speed on the way [unit/s]: never above the limit's rate, or the set-points would run away."""
    limit = robot.limits.get(robot.command.signal)
    return config.speed if limit is None or limit.rate is None else min(config.speed, float(np.min(limit.rate)))


def step_of(robot: RobotConfig) -> float:
    """Time between set-points [s]: whole cycles of the HAL."""
    period = 1.0 / robot.rates.hal
    return period * max(1, round(STEP / period))


def _smooth(share: np.ndarray) -> np.ndarray:
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def _shapes(found: Mapping[str, np.ndarray]) -> str:
    return ", ".join(f"{name} of shape {np.shape(value)}" for name, value in found.items()) or "nothing"
