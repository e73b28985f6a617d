"""The designer's `geometric` model of the arm: links, straight wires, elastic elements, and what follows from them.

simulators/assets/musashi_arm/README.md says where the numbers come from. Pure numpy: no physics engine.
"""

from functools import cache
from pathlib import Path

import numpy as np

from simulators.chain import Chain
from simulators.muscles import Elastic, Paths, Via

URDF = Path(__file__).resolve().parents[2] / "assets" / "musashi_arm" / "musashi_arm.urdf"

TORSO, UPPER_ARM, ULNA, RADIUS = 0, 3, 4, 5
"""These are frames of the chain: the base, and the links behind shoulder_yaw, elbow_pitch and elbow_yaw."""

LEAST_TENSION, MOST_TENSION = 10.0, 180.0
"""Commanded tensions are between these [N]."""

HAND = np.array([0.0, 0.0, -0.25])
"""The hand ends at this point in the frame of the last link [m]."""

ROUTES: dict[str, tuple[Via, ...]] = {
    "deltoid_front": (Via(TORSO, 0.038, 0.005, 0.03), Via(UPPER_ARM, 0.029, -0.004, -0.129)),
    "deltoid_side": (
        Via(TORSO, 0.027, 0.03, 0.069),
        Via(TORSO, 0.018, -0.047, 0.002),
        Via(UPPER_ARM, -0.0, 0.024, -0.14),
    ),
    "deltoid_back": (Via(TORSO, -0.04, 0.002, 0.024), Via(UPPER_ARM, -0.034, 0.009, -0.105)),
    "pectoral": (Via(TORSO, 0.101, 0.043, -0.033), Via(UPPER_ARM, -0.006, -0.044, -0.047)),
    "latissimus": (Via(TORSO, -0.002, 0.096, -0.245), Via(UPPER_ARM, -0.002, 0.029, -0.044)),
    "infraspinatus": (Via(TORSO, -0.095, 0.037, -0.042), Via(UPPER_ARM, -0.016, -0.034, -0.04)),
    "biceps": (
        Via(TORSO, 0.012, -0.023, 0.036),
        Via(UPPER_ARM, 0.016, 0.045, -0.082),
        Via(UPPER_ARM, 0.029, -0.021, -0.221),
        Via(ULNA, 0.035, 0.034, -0.046),
        Via(RADIUS, 0.042, -0.025, -0.054),
    ),
    "brachialis": (Via(UPPER_ARM, 0.023, 0.032, -0.147), Via(ULNA, 0.022, -0.003, -0.042)),
    "triceps": (
        Via(UPPER_ARM, -0.029, -0.031, -0.097),
        Via(UPPER_ARM, -0.047, 0.014, -0.256),
        Via(ULNA, -0.044, -0.002, -0.076),
    ),
    "pronator": (
        Via(UPPER_ARM, 0.027, 0.015, -0.264),
        Via(ULNA, 0.045, -0.022, -0.067),
        Via(RADIUS, 0.029, 0.035, -0.069),
    ),
}


@cache
def chain() -> Chain:
    """Return the links and joints of the URDF."""
    return Chain.from_urdf(URDF)


@cache
def designed_paths() -> Paths:
    """Return the wires as straight lines between their via points."""
    return Paths(chain(), ROUTES)


@cache
def designed_elastic() -> Elastic:
    """Return the elastic elements as in their data sheet: 20 mm at 200 N."""
    return Elastic.of(len(ROUTES), 20.0, 120.0)


def gravity_torque(position: np.ndarray) -> np.ndarray:
    """Return the joint torques [N m] that hold the arm's own weight at joint positions [rad]; shapes (5,)."""
    return chain().gravity_torque(np.asarray(position, float))


def force_torque(position: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the joint torques J^T F [N m], shape (5,), of a force on the hand [N], shape (3,), at joint positions
    [rad].
    """
    pose = chain().pose(np.asarray(position, float))
    hand = pose.points(np.array([RADIUS]), HAND[None])[0]
    wrench = np.concatenate([force, np.cross(hand, force)])
    return np.asarray(chain().moves[RADIUS] * (wrench @ pose.screws()))


def wire_lengths(position: np.ndarray, tension: np.ndarray) -> np.ndarray:
    """Wire lengths [m] that give joint positions [rad] and tensions [N] on the geometric model; shapes (5,), (10,)."""
    return designed_paths().lengths(position) - designed_elastic().elongation(tension)


def balanced_tensions(position: np.ndarray, wish: np.ndarray) -> np.ndarray:
    """Return the tensions [N] nearest to a wish (10,) that hold the arm at joint positions [rad] (5,), within the
    commanded range.

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
        proposed = tension[free] + change
        tension[free] = np.clip(proposed, LEAST_TENSION, MOST_TENSION)
        inside = (proposed > LEAST_TENSION) & (proposed < MOST_TENSION)
        if inside.all():
            break
        free[np.flatnonzero(free)[~inside]] = False
        if not free.any():
            break
    return tension
