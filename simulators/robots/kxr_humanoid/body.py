"""The robot as it can be built: the designer's `nominal` one, and `actual` ones drawn around it from a seed.

simulators/assets/kxr_humanoid/README.md says where the numbers come from. Pure numpy: no physics engine.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from simulators.chain import Chain

URDF = Path(__file__).resolve().parents[2] / "assets" / "kxr_humanoid" / "kxr_humanoid.urdf"
VARIANTS = ("nominal", "actual")

CELLS = np.array([[x, y] for foot in (0.034, -0.034) for x in (0.050, -0.050) for y in (foot + 0.022, foot - 0.022)])
"""The load cells touch the ground at these points: four corners of the left sole, then of the right one [m], shape (8,
2).
"""

REST = np.array([-0.6, 0.0, -0.9, 0.0])
"""A robot starts at these commanded joint positions [rad]: shoulder pitch, shoulder yaw, elbow pitch, ankle pitch."""

ORDER = (1, 2, 3, 0)
"""Element of the command -> joint of the chain; the ankle is first in the chain and last in the command."""


@dataclass(frozen=True, slots=True)
class Tool:
    """A stick with a weight on it, held in the right hand.

    Attributes:
        mass: Mass [kg].
        length: Length from the grip to the tip [m].
        center: Distance from the tip to the centre of mass [m], wherever the stick is gripped.
    """

    mass: float
    length: float
    center: float = 0.12


TOOLS: Mapping[str, Tool] = {
    f"{size}_{weight}": Tool(mass, length)
    for size, length in (("short", 0.176), ("long", 0.236))
    for weight, mass in (("light", 0.040), ("middle", 0.080), ("heavy", 0.120))
}
"""These are the conditions of the paper (III-C)."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera in the head; it leans with the body.

    Attributes:
        position: Position in the body's frame, whose origin is the ankle [m], shape (3,).
        pitch: Angle downwards from straight ahead [rad].
        roll: Angle about its optical axis [rad].
        focal: Focal length [px].
        width: Width of the image [px].
        height: Height of the image [px].
        axes: Directions of depth, down and right as columns in the body's frame, shape (3, 3).
    """

    position: np.ndarray
    pitch: float = 0.35
    roll: float = 0.0
    focal: float = 320.0
    width: int = 640
    height: int = 480

    axes: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        ahead = np.array([math.cos(self.pitch), 0.0, -math.sin(self.pitch)])
        down = np.array([-math.sin(self.pitch), 0.0, -math.cos(self.pitch)])
        right = np.array([0.0, -1.0, 0.0])
        cosine, sine = math.cos(self.roll), math.sin(self.roll)
        axes = np.column_stack([ahead, sine * right + cosine * down, cosine * right - sine * down])
        object.__setattr__(self, "axes", axes)


@dataclass(frozen=True, slots=True)
class Body:
    """One variant of the robot.

    Attributes:
        chain: Links and joints, ankle first.
        foot_mass: Mass of both feet [kg].
        foot_center: Their centre of mass [m], shape (2,), on the ground.
        deflection: Joint deflection per torque, ankle first [rad/(N m)], shape (4,).
        joint_zero: Joint position at zero of its servo, ankle first [rad], shape (4,).
        grip: Place where the tool is held, in the last link's frame [m], shape (3,).
        tool_direction: Direction of the tool from there, in the last link's frame, shape (3,).
        tools: Condition -> tool.
        camera: Camera in the head.
        noise: Standard deviation of measurements, per signal [its unit].
    """

    chain: Chain
    foot_mass: float
    foot_center: np.ndarray
    deflection: np.ndarray
    joint_zero: np.ndarray
    grip: np.ndarray
    tool_direction: np.ndarray
    tools: Mapping[str, Tool]
    camera: Camera
    noise: Mapping[str, float]


@cache
def nominal() -> Body:
    """Return the designer's robot: the URDF's figures, deflection as in the paper's simulation, no noise."""
    return Body(
        chain=Chain.from_urdf(URDF),
        foot_mass=0.076864,
        foot_center=np.array([-0.010, 0.0]),
        deflection=np.radians([15.0, 30.0, 30.0, 30.0]),
        joint_zero=np.zeros(4),
        grip=np.array([0.0377, 0.0, -0.1042]),
        tool_direction=np.array([math.sqrt(0.5), 0.0, -math.sqrt(0.5)]),
        tools=TOOLS,
        camera=Camera(np.array([0.02, 0.0, 0.335])),
        noise={},
    )


def make_body(variant: str, seed: int) -> Body:
    """Return one variant of the robot; the seed chooses among the actual ones.

    Raises:
        ValueError: The variant is not known.
    """
    if variant not in VARIANTS:
        raise ValueError(f"The robot has no variant '{variant}'. Known variants: {', '.join(VARIANTS)}.")
    return nominal() if variant == "nominal" else _actual(nominal(), np.random.default_rng([seed, 11]))


def _actual(body: Body, random: np.random.Generator) -> Body:
    """Return a robot as really built: other stiffness and masses, links a few mm off, servos off zero, noise."""
    chain = body.chain
    built = replace(
        chain,
        offsets=chain.offsets + random.normal(0.0, 0.002, chain.offsets.shape),
        masses=chain.masses * random.uniform(0.92, 1.08, 4),
        centers=chain.centers + random.normal(0.0, 0.003, chain.centers.shape),
    )
    tools = {
        name: replace(
            tool,
            mass=tool.mass * random.uniform(0.95, 1.05),
            length=tool.length + random.normal(0.0, 0.002),
            center=tool.center + random.normal(0.0, 0.002),
        )
        for name, tool in body.tools.items()
    }
    camera = replace(
        body.camera,
        position=body.camera.position + random.normal(0.0, 0.003, 3),
        pitch=body.camera.pitch + random.normal(0.0, 0.02),
        roll=random.normal(0.0, 0.01),
        focal=body.camera.focal * random.uniform(0.98, 1.02),
    )
    direction = body.tool_direction + random.normal(0.0, 0.02, 3)
    return replace(
        body,
        chain=built,
        deflection=body.deflection * random.uniform(0.7, 1.4, 4),
        joint_zero=random.normal(0.0, 0.015, 4),
        grip=body.grip + random.normal(0.0, 0.002, 3),
        tool_direction=direction / np.linalg.norm(direction),
        tools=tools,
        camera=camera,
        noise=NOISE,
    )


NOISE = {"joint_position": 0.002, "foot_force": 0.03, "tool_tip_position": 0.002, "tool_tip_pixel": 1.0}
"""The actual robot's sensors have these standard deviations [rad, N, m, px]."""
