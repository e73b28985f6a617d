"""What the arm is made of: the designer's `geometric` model, and `actual` robots drawn around it from a seed.

simulators/assets/musashi_arm/README.md says where the numbers come from.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from simulators.chain import Chain
from simulators.muscle_world import Body, Friction
from simulators.muscles import Elastic, Paths, Sphere, Via

URDF = Path(__file__).resolve().parents[2] / "assets" / "musashi_arm" / "musashi_arm.urdf"
VARIANTS = ("geometric", "actual")

TORSO, UPPER_ARM, ULNA, RADIUS = 0, 3, 4, 5
"""Frames of the chain: the base, and the links behind shoulder_yaw, elbow_pitch and elbow_yaw."""

REST = np.array([0.0, 0.0, 0.0, -0.6, 0.0])
"""Joint positions at which a robot starts and its wire lengths are calibrated [rad]."""
REST_PRETENSION = 40.0
"""[N]"""

ROUTES: dict[str, tuple[Via, ...]] = {
    "deltoid_front": (Via(TORSO, 0.055, 0.01, 0.05), Via(UPPER_ARM, 0.03, -0.03, -0.12)),
    "deltoid_side": (
        Via(TORSO, 0.0, -0.01, 0.07),
        Via(TORSO, 0.0, -0.05, 0.045),
        Via(UPPER_ARM, 0.0, -0.04, -0.12),
    ),
    "deltoid_back": (Via(TORSO, -0.055, 0.01, 0.05), Via(UPPER_ARM, -0.03, -0.03, -0.12)),
    "pectoral": (Via(TORSO, 0.06, 0.12, -0.04), Via(UPPER_ARM, 0.035, -0.01, -0.07)),
    "latissimus": (Via(TORSO, -0.05, 0.10, -0.20), Via(UPPER_ARM, 0.0, 0.035, -0.08)),
    "infraspinatus": (Via(TORSO, -0.08, 0.08, 0.0), Via(UPPER_ARM, -0.02, -0.04, -0.03)),
    "biceps": (
        Via(TORSO, 0.04, 0.0, 0.04),
        Via(UPPER_ARM, 0.045, 0.01, -0.05),
        Via(UPPER_ARM, 0.045, 0.01, -0.19),
        Via(ULNA, 0.045, 0.03, -0.06),
        Via(RADIUS, 0.03, -0.02, -0.09),
    ),
    "brachialis": (Via(UPPER_ARM, 0.035, -0.01, -0.14), Via(ULNA, 0.035, -0.01, -0.07)),
    "triceps": (
        Via(UPPER_ARM, -0.035, 0.0, -0.10),
        Via(UPPER_ARM, -0.035, 0.0, -0.22),
        Via(ULNA, -0.035, 0.0, -0.04),
    ),
    "pronator": (
        Via(UPPER_ARM, 0.02, 0.035, -0.22),
        Via(ULNA, 0.03, -0.035, -0.06),
        Via(RADIUS, 0.03, 0.02, -0.09),
    ),
}

JOINT_DAMPING = np.array([0.4, 0.4, 0.2, 0.2, 0.05])
"""[N m s/rad]"""
LOSS_TIME = 0.01
"""Of the elastic elements [s]."""
NOISE = {"joint_position": 0.001, "muscle_tension": 0.5, "muscle_length": 0.05e-3}
"""Of the actual robot's sensors [rad, N, m]."""


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


def body(variant: str, seed: int) -> Body:
    """One variant of the arm; the seed chooses among the actual ones.

    Raises:
        ValueError: No such variant.
    """
    if variant not in VARIANTS:
        raise ValueError(f"The arm has no variant '{variant}'. Known variants: {', '.join(VARIANTS)}.")
    size = len(ROUTES)
    tension = np.full(size, REST_PRETENSION)
    geometric = Body(
        urdf=URDF,
        paths=designed_paths(),
        elastic=designed_elastic(),
        slack=np.zeros(size),
        joint_damping=JOINT_DAMPING,
        loss_time=LOSS_TIME,
        friction=None,
        noise={},
        rest=REST,
        rest_tension=tension,
    )
    return geometric if variant == "geometric" else _actual(geometric, np.random.default_rng([seed, 5]))


def _actual(geometric: Body, random: np.random.Generator) -> Body:
    """An arm as it was really built: every via point 5 to 10 mm off, bent wires, other elasticity, friction, noise."""
    size = len(ROUTES)
    routes = {name: tuple(_moved(via, random) for via in route) for name, route in ROUTES.items()}
    radius = random.uniform(0.018, 0.024, 2)
    spheres = (
        Sphere(UPPER_ARM, (0.0, 0.0, 0.0), radius[0]),
        Sphere(ULNA, (0.0, 0.0, 0.0), radius[1]),
    )
    paths = Paths(chain(), routes, spheres)
    elastic = Elastic(20.0 * random.uniform(0.75, 1.3, size), 120.0 * random.uniform(0.8, 1.2, size))
    friction = Friction(
        joint_torque=np.array([0.25, 0.25, 0.12, 0.12, 0.05]) * random.uniform(0.6, 1.4, 5),
        joint_presliding=0.01,
        wire=random.uniform(0.04, 0.10, size),
        wire_presliding=0.001,
    )
    slack = paths.lengths(REST) - designed_paths().lengths(REST)
    return replace(geometric, paths=paths, elastic=elastic, slack=slack, friction=friction, noise=NOISE)


def _moved(via: Via, random: np.random.Generator) -> Via:
    way = random.standard_normal(3)
    x, y, z = way / np.linalg.norm(way) * random.uniform(0.005, 0.010)
    return Via(via.frame, via.x + x, via.y + y, via.z + z)
