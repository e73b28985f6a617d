"""The arm as it can be built: the designer's `geometric` variant, and `actual` ones drawn around it from a seed.

simulators/assets/musashi_arm/README.md says where the numbers come from.
"""

from dataclasses import replace

import numpy as np

from simulators.muscle_body import Body, Friction
from simulators.muscles import Elastic, Paths, Sphere, Via
from simulators.robots.musashi_arm.model import (
    ROUTES,
    ULNA,
    UPPER_ARM,
    URDF,
    balanced_tensions,
    chain,
    designed_elastic,
    designed_paths,
)

VARIANTS = ("geometric", "actual")

REST = np.array([0.0, 0.0, 0.0, -0.6, 0.0])
"""A robot starts, and its wire lengths are calibrated, at these joint positions [rad]."""
REST_PRETENSION = 40.0
"""Every wire has this tension at rest [N]."""

JOINT_DAMPING = np.array([0.8, 0.8, 0.3, 0.35, 0.08])
"""Every joint has this damping [N m s/rad]."""
ZERO_ERROR = 0.006
"""This is the standard deviation of an actual robot's wire length calibration [m]."""
LOSS_TIME = 0.025
"""The elastic elements have this loss time [s]."""
NOISE = {"joint_position": 0.001, "muscle_tension": 0.5, "muscle_length": 0.05e-3}
"""The actual robot's sensors have these standard deviations [rad, N, m]."""


def make_body(variant: str, seed: int) -> Body:
    """Return one variant of the arm; the seed chooses among the actual ones.

    Raises:
        ValueError: The variant is not known.
    """
    if variant not in VARIANTS:
        raise ValueError(f"The arm has no variant '{variant}'. Known variants: {', '.join(VARIANTS)}.")
    size = len(ROUTES)
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
        rest_tension=balanced_tensions(REST, np.full(size, REST_PRETENSION)),
    )
    return geometric if variant == "geometric" else _actual(geometric, np.random.default_rng([seed, 5]))


def _actual(geometric: Body, random: np.random.Generator) -> Body:
    """Return an arm as really built: every via point 7 to 10 mm off, bent wires, other elasticity, friction, noise."""
    size = len(ROUTES)
    routes = {name: tuple(_moved(via, random) for via in route) for name, route in ROUTES.items()}
    radius = random.uniform(0.025, 0.035, 2)
    spheres = (
        Sphere(UPPER_ARM, (0.0, 0.0, 0.0), radius[0]),
        Sphere(ULNA, (0.0, 0.0, 0.0), radius[1]),
    )
    paths = Paths(chain(), routes, spheres)
    elastic = Elastic(20.0 * random.uniform(0.6, 1.4, size), 120.0 * random.uniform(0.6, 1.15, size))
    friction = Friction(
        joint_torque=np.array([0.25, 0.25, 0.12, 0.12, 0.05]) * random.uniform(0.6, 1.4, 5),
        joint_presliding=0.01,
        wire=random.uniform(0.04, 0.10, size),
        wire_presliding=0.001,
        guide=random.uniform(0.10, 0.25, size),
        guide_presliding=0.002,
    )
    slack = paths.lengths(REST) - designed_paths().lengths(REST) + random.normal(0.0, ZERO_ERROR, size)
    return replace(geometric, paths=paths, elastic=elastic, slack=slack, friction=friction, noise=NOISE)


def _moved(via: Via, random: np.random.Generator) -> Via:
    way = random.standard_normal(3)
    x, y, z = way / np.linalg.norm(way) * random.uniform(0.007, 0.010)
    return Via(via.frame, via.x + x, via.y + y, via.z + z)
