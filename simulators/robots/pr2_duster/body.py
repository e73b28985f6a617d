"""The arm as it can be built: the designer's `nominal` variant, and `actual` ones drawn around it from a seed.

simulators/assets/pr2_duster/README.md says where the numbers come from. Pure numpy: no physics engine.
"""

import math
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from simulators.chain import Chain
from simulators.robots.pr2_duster.duster import FLEXIBLE, NORMAL, Grasp

URDF = Path(__file__).resolve().parents[2] / "assets" / "pr2_duster" / "pr2_arm.urdf"
VARIANTS = ("nominal", "actual")

REST = np.array([-0.6, 0.3, -0.9, -1.35, 0.1, -0.9, 0.1])
"""A robot starts at these joint positions [rad]."""
FASTEST = np.array([2.088, 2.082, 3.27, 3.3, 3.6, 3.078, 3.6])
"""The joints have these highest speeds [rad/s]."""
LAG = 0.02
"""The joints' position loops have this time constant [s]."""
GRIP = 0.18
"""The grip is this far from the wrist's axes, along the hand's x axis [m]."""


@dataclass(frozen=True, slots=True)
class Body:
    """One variant of the arm.

    Attributes:
        zero: Joint positions minus positions of the encoders [rad], shape (7,).
        grip: Place where the fingers grip, in the hand's frame [m], shape (3,).
        camera_turn: Rotation from the base to its frame as the camera has it, shape (3, 3).
        camera_shift: Offset of the camera's positions [m], shape (3,).
        encoder_noise: Standard deviation of the encoders [rad].
        camera_noise: Standard deviation of the camera [m].
        rough_length: Standard deviation of the lengths at which a duster is put into the hand [m].
        rough_angle: Standard deviation of the angles of the grasp [rad].
        condition: Grasp at the start.
    """

    zero: np.ndarray = field(default_factory=lambda: np.zeros(7))
    grip: np.ndarray = field(default_factory=lambda: np.array([GRIP, 0.0, 0.0]))
    camera_turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    camera_shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    encoder_noise: float = 0.0
    camera_noise: float = 0.0
    rough_length: float = 0.0
    rough_angle: float = 0.0
    condition: str = NORMAL[0]


def make_body(variant: str, seed: int) -> Body:
    """Return one variant of the arm; the seed chooses among the actual ones.

    Raises:
        ValueError: The variant is not known.
    """
    if variant not in VARIANTS:
        raise ValueError(f"The arm has no variant '{variant}'. Known variants: {', '.join(VARIANTS)}.")
    if variant == "nominal":
        return Body()
    random = np.random.default_rng([seed, 7])
    return Body(
        zero=random.normal(0.0, 0.01, 7),
        grip=np.array([GRIP, 0.0, 0.0]) + random.normal(0.0, 0.003, 3),
        camera_turn=_turn(random.normal(0.0, 0.01, 3)),
        camera_shift=random.normal(0.0, 0.01, 3),
        encoder_noise=0.0005,
        camera_noise=0.005,
        rough_length=0.01,
        rough_angle=math.radians(3.0),
        condition=FLEXIBLE[0],
    )


def _turn(vector: np.ndarray) -> np.ndarray:
    """Return the rotation by a vector [rad], shape (3, 3)."""
    angle = float(np.linalg.norm(vector))
    cross = np.cross(np.eye(3), vector / angle)
    turn: np.ndarray = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return turn


@cache
def chain() -> Chain:
    """Return the links and joints of the URDF."""
    return Chain.from_urdf(URDF)


def hand(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the designer's hand at joint positions [rad] (k, 7): orientations (k, 3, 3), places of the grip [m] (k,
    3).
    """
    rotation, origin = chain().ends(positions)
    return rotation, origin + GRIP * rotation[:, :, 0]


def tool_tip(grasp: Grasp, positions: np.ndarray) -> np.ndarray:
    """Return the designer's tool tip [m], shape (k, 3), at joint positions [rad], shape (k, 7)."""
    return grasp.cloth(*hand(positions))
