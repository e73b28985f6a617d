"""Random motion of an arm from a URDF that touches neither itself nor the floor."""

from collections.abc import Iterator

import numpy as np

from hal.config import RobotConfig
from hal.errors import ConfigError
from simulators.physics.choice import ServoArm, make_arm, using
from simulators.robots.urdf_arm.body import MOTOR, arm_in
from simulators.robots.urdf_arm.body_file import physics_urdf
from simulators.robots.urdf_arm.survey import FASTEST, neutral

STEP = 0.02
"""Set-points of a move have this distance in time [s]."""
HOLD = 0.2
"""The arm rests for this time [s] in every posture."""
CHECKED = 0.1
"""A move is checked at points that are at most this far apart [rad]."""
CLEARANCE = 0.01
"""A move keeps this share of the reach away from what it could touch, or half of the distance of the first posture if
that is less: the arm follows late, and gears twist."""
TRIES = 300
"""At most this many postures are drawn for one move."""


def random_motion(config: RobotConfig, seed: int) -> Iterator[tuple[np.ndarray, float]]:
    """Yield motor positions [rad], shape (n,), and the time to command each [s], without end.

    Postures are drawn within the limits. The straight moves between them touch nothing, and are smooth in time.

    Raises:
        ConfigError: No posture can be reached without contact.
    """
    limit = config.limits[MOTOR]
    speed = min(FASTEST, float(np.min(limit.rate if limit.rate is not None else FASTEST)))
    position, postures = None, free_postures(config, seed)
    for goal in postures:
        if position is not None:
            away = float(np.abs(goal - position).max())
            count = max(1, int(np.ceil(max(0.2, 1.875 * away / speed) / STEP)))
            share = np.arange(1, count + 1)[:, None] / count
            for point in position + share**3 * (10.0 - 15.0 * share + 6.0 * share**2) * (goal - position):
                yield point, STEP
        yield goal, HOLD
        position = goal


def free_postures(config: RobotConfig, seed: int) -> Iterator[np.ndarray]:
    """Yield postures [rad], shape (n,), the middle one first; straight moves from each to the next touch nothing.

    Raises:
        ConfigError: No posture can be reached without contact.
    """
    arm, random = arm_in(config), np.random.default_rng(seed)
    low, high = config.bounds(MOTOR)
    text, _ = physics_urdf(arm)
    with using(config.physics):
        body = make_arm(text, arm.names, neutral(arm), np.ones(low.size))
    try:
        position = 0.5 * (low + high)
        clearance = max(0.0, 0.5 * body.distance(position, 2.0 * CLEARANCE * arm.reach))
        yield position
        while True:
            position = _next(body, random, position, low, high, clearance)
            yield position
    finally:
        body.close()


def _next(
    body: ServoArm,
    random: np.random.Generator,
    position: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    clearance: float,
) -> np.ndarray:
    for _ in range(TRIES):
        goal = random.uniform(low, high)
        count = max(2, int(np.ceil(np.abs(goal - position).max() / CHECKED)))
        points = position + np.arange(count, 0, -1)[:, None] / count * (goal - position)
        if all(body.distance(point, clearance) >= clearance for point in points):
            return goal
    raise ConfigError(
        f"None of {TRIES} random postures is reached without contact. Narrow limits.{MOTOR}, or remove <collision> of "
        "links that overlap in the URDF."
    )
