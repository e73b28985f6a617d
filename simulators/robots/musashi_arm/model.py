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
"""Frames of the chain: the base, and the links behind shoulder_yaw, elbow_pitch and elbow_yaw."""

LEAST_TENSION, MOST_TENSION = 10.0, 180.0
"""Tensions that are ever asked for [N]."""

ROUTES: dict[str, tuple[Via, ...]] = {
    "deltoid_front": (Via(TORSO, 0.02, 0.003, 0.065), Via(UPPER_ARM, 0.037, -0.008, -0.124)),
    "deltoid_side": (
        Via(TORSO, 0.001, 0.013, 0.087),
        Via(TORSO, 0.019, -0.058, 0.01),
        Via(UPPER_ARM, -0.027, -0.017, -0.132),
    ),
    "deltoid_back": (Via(TORSO, -0.057, -0.004, 0.014), Via(UPPER_ARM, -0.026, 0.003, -0.115)),
    "pectoral": (Via(TORSO, 0.07, 0.086, -0.058), Via(UPPER_ARM, 0.012, -0.037, -0.062)),
    "latissimus": (Via(TORSO, -0.055, 0.064, -0.188), Via(UPPER_ARM, -0.01, 0.027, -0.054)),
    "infraspinatus": (Via(TORSO, -0.091, 0.044, -0.011), Via(UPPER_ARM, -0.02, -0.047, -0.03)),
    "biceps": (
        Via(TORSO, 0.009, -0.021, 0.032),
        Via(UPPER_ARM, 0.022, 0.03, -0.06),
        Via(UPPER_ARM, 0.032, 0.006, -0.208),
        Via(ULNA, 0.035, 0.036, -0.039),
        Via(RADIUS, 0.048, -0.023, -0.06),
    ),
    "brachialis": (Via(UPPER_ARM, 0.021, 0.021, -0.125), Via(ULNA, 0.038, -0.006, -0.046)),
    "triceps": (
        Via(UPPER_ARM, -0.043, -0.019, -0.077),
        Via(UPPER_ARM, -0.047, -0.0, -0.247),
        Via(ULNA, -0.05, -0.005, -0.014),
    ),
    "pronator": (
        Via(UPPER_ARM, 0.01, 0.027, -0.252),
        Via(ULNA, 0.045, -0.01, -0.068),
        Via(RADIUS, 0.034, 0.037, -0.07),
    ),
}


@cache
def chain() -> Chain:
    """The links and joints, as the URDF has them."""
    return Chain.from_urdf(URDF)


@cache
def designed_paths() -> Paths:
    """The wires as straight lines between their via points."""
    return Paths(chain(), ROUTES)


@cache
def designed_elastic() -> Elastic:
    """The elastic elements as their data sheet would have them: 20 mm at 200 N."""
    return Elastic.of(len(ROUTES), 20.0, 120.0)


def gravity_torque(position: np.ndarray) -> np.ndarray:
    """Joint torques [N m] that hold the arm's own weight at joint positions [rad]; shapes (5,)."""
    return chain().gravity_torque(np.asarray(position, float))


def wire_lengths(position: np.ndarray, tension: np.ndarray) -> np.ndarray:
    """Wire lengths [m] that give joint positions [rad] and tensions [N] on the geometric model; shapes (5,), (10,)."""
    return designed_paths().lengths(position) - designed_elastic().elongation(tension)


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
