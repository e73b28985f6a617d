"""Dusters in the hand: a stiff one, or a flexible one whose foam joint sags, and the place of its cloth.

simulators/assets/pr2_duster/README.md says where the numbers come from. Pure numpy: no physics engine.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simulators.chain import GRAVITY

CLOTH = 0.1
"""The centre of the hanging cloth is this far below the tip of the stick [m]."""
LENGTHS = (0.3, 0.5, 0.7)
ANGLES = (0, 30, 60)
"""The paper has these grasping angles [deg]."""
BETWEEN = ((0.4, 15), (0.6, 45))
"""No model is trained on these lengths [m] and angles [deg]; a grasp that was never held must be recognised too."""


@dataclass(frozen=True, slots=True)
class Foam:
    """A stick that continues the held one behind a piece of foam, which bends in any direction.

    Attributes:
        length: Length of the stick behind the foam [m].
        stiffness: Torque that bends the foam [N m/rad].
        moment: First mass moment about the foam of everything that hangs on it [kg m].
    """

    length: float
    stiffness: float
    moment: float


@dataclass(frozen=True, slots=True)
class Grasp:
    """Grasp of a duster.

    Attributes:
        length: Length from the hand to the tip of the stick, or to the foam [m].
        angle: Angle by which the stick is turned out of the hand's x axis, about the axis across the fingers (y) [rad].
        foam: The foam and the stick behind it; None for a stiff duster.
    """

    length: float
    angle: float
    foam: Foam | None = None

    def cloth(self, rotation: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Return the centre of the cloth, at rest.

        Args:
            rotation: Orientations of the hand, shape (k, 3, 3).
            origin: Places of the grip [m], shape (k, 3).

        Returns:
            Positions [m], shape (k, 3), in the frame of `origin`, whose z is up.
        """
        along = rotation @ np.array([math.cos(self.angle), 0.0, -math.sin(self.angle)])
        tip: np.ndarray = origin + self.length * along
        if self.foam is not None:
            tip = tip + self.foam.length * sagged(self.foam, along)
        return tip - np.array([0.0, 0.0, CLOTH])


def sagged(foam: Foam, along: np.ndarray) -> np.ndarray:
    """Return directions of the stick behind the foam, at rest, from directions before it; both unit vectors of shape
    (k, 3).

    The stick falls in the vertical plane of the one before it, from the elevation a to b where the foam's torque
    carries the weight: stiffness (a - b) = moment g cos(b). With stiffness > moment g that is one posture.
    """
    flat = np.hypot(along[:, 0], along[:, 1])
    before = np.arctan2(along[:, 2], flat)
    behind = _balanced(before, foam.moment * GRAVITY / foam.stiffness)
    heading = along[:, :2] / np.maximum(flat, 1e-12)[:, None]
    return np.column_stack([np.cos(behind)[:, None] * heading, np.sin(behind)])


def _balanced(elevation: np.ndarray, load: float) -> np.ndarray:
    """Solve a - b = load cos(b) for b [rad], shape (k,): bisection in [a - load, a], then Newton's last digits."""
    low, high = elevation - load, elevation
    for _ in range(5):
        middle = 0.5 * (low + high)
        is_above = elevation - middle < load * np.cos(middle)
        low, high = np.where(is_above, low, middle), np.where(is_above, middle, high)
    angle = 0.5 * (low + high)
    for _ in range(3):
        angle = angle - (angle + load * np.cos(angle) - elevation) / (1.0 - load * np.sin(angle))
    return angle


_FOAM = Foam(length=0.5, stiffness=0.7, moment=0.1 * 0.25 + 0.05 * 0.5)

GRASPS: Mapping[str, Grasp] = {
    **{f"l{1e3 * length:.0f}_phi{phi}": Grasp(length, math.radians(phi)) for length in LENGTHS for phi in ANGLES},
    **{f"l{1e3 * length:.0f}_phi{phi}": Grasp(length, math.radians(phi)) for length, phi in BETWEEN},
    **{
        f"{name}_phi{phi}": Grasp(length, math.radians(phi), _FOAM)
        for name, length in (("short", 0.1), ("long", 0.2))
        for phi in ANGLES
    },
}
"""Condition -> grasp, nine of the normal duster and two between them, six of the flexible one."""
NORMAL = tuple(f"l{1e3 * length:.0f}_phi{phi}" for length in LENGTHS for phi in ANGLES)
FLEXIBLE = tuple(name for name, grasp in GRASPS.items() if grasp.foam is not None)
