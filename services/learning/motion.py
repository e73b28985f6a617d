"""Motion of a robot during a recording: random postures that are safe by the designer's model, and moves to them."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from services.errors import ServiceError
from services.model.model_config import CollectConfig

STEP = 0.02
"""Set-points of a move are this time [s] apart, or the HAL's period if it is longer."""
PEAK = 1.875
"""The highest speed of a minimum-jerk move is this multiple of its mean speed."""
SHORTEST = 0.1
"""A move lasts at least this long [s]."""
CHECKS = 24
"""This many points of a move are forecast in addition to its end."""
BATCH = 64
"""Random postures are drawn and forecast in batches of this size."""
TRIES = 200
"""At most this many batches, and this many moves, are tried."""

Move = tuple[np.ndarray, float]
"""A move is a command [unit of the commanded signal], shape (k,), and its duration [s]."""
Motion = Callable[[np.ndarray], Iterator[Move]]
"""A motion takes the robot's position, shape (k,), and yields moves."""


class NowhereToGo(ServiceError):
    """No random posture, or no move to one, keeps the constraints; the text names the violated constraints."""


class Forecast:
    """Forecast of the designer's model for commands, compared with the constraints of the `collect` section."""

    def __init__(self, robot: RobotConfig, config: CollectConfig, condition: str | None) -> None:
        """Load the model.

        Raises:
            ConfigError: The model does not exist, or does not forecast a constrained signal.
        """
        self._signals = tuple(config.constraints)
        self._bounds: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        if not self._signals:
            return
        name = str(config.forecast)
        self._model = partial(registry.load_object(name), robot, condition)
        low, _ = robot.bounds(robot.command.signal)
        forecast = self._model(np.zeros((1, low.size)))
        for signal in self._signals:
            size = robot.signals[signal].size
            if signal not in forecast or np.shape(forecast[signal]) != (1, size):
                raise ConfigError(
                    f"{name} forecasts {_shapes(forecast)}; collect.constraints need {signal} of shape (1, {size}) "
                    "for one command."
                )
            self._bounds[signal] = config.constraints[signal].bounds(size, f"constraints.{signal}")

    def outside(self, commands: np.ndarray, no_worse_than: np.ndarray | None = None) -> np.ndarray:
        """Return the constraints that commands violate; a value that cannot be forecast violates its constraint.

        Args:
            commands: Commands [unit of the commanded signal], shape (n, k).
            no_worse_than: A command, shape (k,); violations up to those of this command are tolerated.

        Returns:
            Booleans, shape (n, constraints).
        """
        violated = np.zeros((len(commands), len(self._signals)), bool)
        if not self._signals:
            return violated
        forecast = self._model(commands)
        tolerated = {} if no_worse_than is None else self._model(no_worse_than[None])
        for index, signal in enumerate(self._signals):
            low, high = self._bounds[signal]
            inside = (forecast[signal] >= low) & (forecast[signal] <= high)
            if signal in tolerated:
                value = tolerated[signal][0]
                between = (forecast[signal] >= np.minimum(low, value)) & (forecast[signal] <= np.maximum(high, value))
                inside = between | np.isnan(value)
            violated[:, index] = ~inside.all(axis=1)
        return violated

    def blame(self, violated: np.ndarray) -> str:
        """Return a text with the share of tries that each constraint refused; `violated` has shape (n, constraints)."""
        shares = violated.mean(axis=0)
        return ", ".join(f"{signal} refused {share:.0%}" for signal, share in zip(self._signals, shares, strict=True))


def minimum_jerk(start: np.ndarray, goal: np.ndarray, speed: float, step: float) -> np.ndarray:
    """Return set-points of a minimum-jerk move every `step` [s], the goal last, shape (n, k).

    Args:
        start: First command, shape (k,).
        goal: Last command, shape (k,).
        speed: Highest speed of an element [unit/s].
        step: Time between set-points [s].
    """
    duration = max(SHORTEST, PEAK * float(np.abs(goal - start).max()) / speed)
    count = max(1, int(np.ceil(duration / step)))
    return start + np.outer(_smooth(np.arange(1, count + 1) / count), goal - start)


def random_postures(robot: RobotConfig, config: CollectConfig, condition: str | None, seed: int) -> Motion:
    """Return a motion of random postures within the limits of the commanded signal and smooth moves between them.

    By the forecast all postures and moves keep the constraints. Only the first move may violate them, as far as its
    start does.

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
        tolerated: np.ndarray | None = start
        while True:
            goal = _next_posture(forecast, random, (low, high), start, tolerated)
            yield from ((point, step) for point in minimum_jerk(start, goal, speed, step))
            if config.hold:
                yield goal, config.hold
            start, tolerated = goal, None

    return moves


def _next_posture(
    forecast: Forecast,
    random: np.random.Generator,
    limits: tuple[np.ndarray, np.ndarray],
    start: np.ndarray,
    tolerated: np.ndarray | None,
) -> np.ndarray:
    """Return a posture, shape (k,), that keeps the constraints with a straight move to it."""
    shares = np.arange(1, CHECKS + 1)[:, None] / (CHECKS + 1)
    drawn, moves = [], []
    for _ in range(TRIES):
        goals = random.uniform(*limits, (BATCH, start.size))
        outside = forecast.outside(goals)
        drawn.append(outside)
        for goal in goals[~outside.any(axis=1)]:
            moves.append(forecast.outside(start + shares * (goal - start), tolerated))
            if not moves[-1].any():
                return goal
            if len(moves) >= TRIES:
                break
        if len(moves) >= TRIES:
            break
    advice = "Widen collect.constraints, or narrow the limits of the commanded signal to postures that keep them."
    if not moves:
        shares_text = forecast.blame(np.concatenate(drawn))
        raise NowhereToGo(f"All {TRIES * BATCH} random postures violate the constraints: {shares_text}. {advice}")
    shares_text = forecast.blame(np.array([move.any(axis=0) for move in moves]))
    raise NowhereToGo(
        f"All {len(moves)} moves from the robot's position violate the constraints: {shares_text}. {advice}"
    )


def speed_of(robot: RobotConfig, config: CollectConfig) -> float:
    """Return the highest speed of a move [unit/s], at most the limit's rate, so that the drives can follow."""
    limit = robot.limits.get(robot.command.signal)
    return config.speed if limit is None or limit.rate is None else min(config.speed, float(np.min(limit.rate)))


def step_of(robot: RobotConfig) -> float:
    """Return the time between set-points [s], a multiple of the HAL's period."""
    period = 1.0 / robot.rates.hal
    return period * max(1, round(STEP / period))


def _smooth(share: np.ndarray) -> np.ndarray:
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def _shapes(values: Mapping[str, np.ndarray]) -> str:
    return ", ".join(f"{name} of shape {np.shape(value)}" for name, value in values.items()) or "nothing"
