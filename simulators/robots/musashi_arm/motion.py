"""Random safe motion, made by the designer's model: from posture to posture, at tensions that balance gravity."""

from collections.abc import Iterator

import numpy as np

from hal.config import RobotConfig
from simulators.robots.musashi_arm.body import REST, designed_paths, gravity_torque, wire_lengths

LEAST_TENSION, MOST_TENSION = 10.0, 180.0
"""Tensions that are asked for [N]."""
STEP = 0.02
"""Time between set-points on the way [s]."""
FASTEST_JOINT = 1.2
"""Highest joint speed on the way [rad/s]."""
SETTLE = 0.5
"""Rest in every posture [s]."""


def random_motion(config: RobotConfig, seed: int) -> Iterator[tuple[np.ndarray, float]]:
    """Wire lengths [m], shape (10,), and how long each is to be commanded [s], without end.

    Random joint positions within the robot file's limits and random tensions that balance gravity there, as nearly as
    the muscles can. On the way joints and tensions move along a smooth step in time; each posture is held to settle.
    """
    random = np.random.default_rng(seed)
    low, high = config.bounds("joint_position")
    position, tension = REST, balanced_tensions(REST, np.full(10, 40.0))
    while True:
        next_position = random.uniform(low, high)
        next_tension = balanced_tensions(next_position, random.uniform(LEAST_TENSION, 0.6 * MOST_TENSION, 10))
        duration = max(0.4, 1.9 * np.abs(next_position - position).max() / FASTEST_JOINT)
        count = int(np.ceil(duration / STEP))
        for index in range(1, count + 1):
            share = index / count
            share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            between = position + share * (next_position - position)
            yield wire_lengths(between, tension + share * (next_tension - tension)), STEP
        yield wire_lengths(next_position, next_tension), SETTLE
        position, tension = next_position, next_tension


def balanced_tensions(position: np.ndarray, wish: np.ndarray) -> np.ndarray:
    """Tensions [N] nearest to a wish (10,) that hold the arm at joint positions [rad] (5,), within what may be asked.

    Each round corrects the free muscles by the least change that balances gravity, and pins those that would leave
    the range; what the free ones cannot balance any more stays unbalanced.
    """
    _, arms = designed_paths().solve(position)
    torque = -gravity_torque(position)
    tension = np.clip(wish, LEAST_TENSION, MOST_TENSION)
    free = np.ones(len(tension), dtype=bool)
    for _ in range(len(tension)):
        missing = torque - arms.T @ tension
        change = np.linalg.pinv(arms[free].T, rcond=1e-3) @ missing
        wanted = tension[free] + change
        tension[free] = np.clip(wanted, LEAST_TENSION, MOST_TENSION)
        inside = (wanted > LEAST_TENSION) & (wanted < MOST_TENSION)
        if inside.all():
            break
        free[np.flatnonzero(free)[~inside]] = False
        if not free.any():
            break
    return tension
