"""Random safe motion, and random states of the body, made by the designer's model."""

from collections.abc import Iterator

import numpy as np

from hal.config import RobotConfig
from simulators.robots.musashi_arm.body import REST
from simulators.robots.musashi_arm.model import LEAST_TENSION, MOST_TENSION, balanced_tensions, wire_lengths

HIGHEST_WISH = 110.0
"""Random tensions are drawn below this [N], so that balancing gravity has room above."""
STEP = 0.02
"""Set-points of a move have this distance in time [s]."""
FASTEST_JOINT = 1.2
"""A joint has at most this speed in a move [rad/s]."""
SETTLE = 0.5
"""The arm rests this long in every posture [s]."""


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
        next_tension = balanced_tensions(next_position, random.uniform(LEAST_TENSION, HIGHEST_WISH, 10))
        duration = max(0.4, 1.9 * np.abs(next_position - position).max() / FASTEST_JOINT)
        count = int(np.ceil(duration / STEP))
        for index in range(1, count + 1):
            share = index / count
            share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            between = position + share * (next_position - position)
            yield wire_lengths(between, tension + share * (next_tension - tension)), STEP
        yield wire_lengths(next_position, next_tension), SETTLE
        position, tension = next_position, next_tension


def random_states(config: RobotConfig, count: int, seed: int) -> dict[str, np.ndarray]:
    """Return states of the geometric model, also such in which the arm could not rest (paper, III-B, initial training).

    Joint positions within the robot file's limits and tensions up to the highest commanded one are drawn
    independently; wire lengths follow. Motion alone shows only tensions that balance gravity, from which a model cannot
    predict an unusual load; and an arm that was built otherwise pulls harder than commanded.

    Returns:
        Signal -> values [its unit], shape (count, n).
    """
    random = np.random.default_rng(seed)
    low, high = config.bounds("joint_position")
    position = random.uniform(low, high, (count, 5))
    tension = random.uniform(LEAST_TENSION, MOST_TENSION, (count, 10))
    lengths = np.array([wire_lengths(q, f) for q, f in zip(position, tension, strict=True)])
    return {"joint_position": position, "muscle_tension": tension, "muscle_length": lengths}
