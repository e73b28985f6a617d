"""Parts of a muscle-driven body, as plain numbers; no physics engine."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simulators.muscles import Elastic, Paths


@dataclass(frozen=True, slots=True)
class Friction:
    """Dry friction with a presliding range, so that it also acts at rest: force = limit * (slid / presliding).

    Attributes:
        joint_torque: Coulomb torque of each joint [N m], shape (n,).
        joint_presliding: Joint travel until it slips [rad].
        wire: Share of the tension that is lost along a wire over the joints, shape (m,).
        wire_presliding: Path travel until it slips [m].
        guide: Share of the tension that is lost between load cell (at the spool) and elastic element, shape (m,).
        guide_presliding: Travel of the spool until it slips [m].
    """

    joint_torque: np.ndarray
    joint_presliding: float
    wire: np.ndarray
    wire_presliding: float
    guide: np.ndarray
    guide_presliding: float


@dataclass(frozen=True, slots=True)
class Servo:
    """Abilities of every spool.

    Attributes:
        speed: Highest speed of the wire [m/s].
        lag: Time constant of the position loop [s].
        force: Tension at which the driven spool slips [N].
        brake: Tension at which the brake slips [N].
    """

    speed: float = 0.2
    lag: float = 0.008
    force: float = 350.0
    brake: float = 450.0


@dataclass(frozen=True, slots=True)
class Body:
    """One variant of a muscle-driven robot.

    Attributes:
        urdf: File of the rigid links.
        paths: Paths of the wires.
        elastic: Elastic elements of the wires.
        slack: Wire length that counts as zero: path length minus reported length [m], shape (m,).
        joint_damping: Viscous torque of each joint [N m s/rad], shape (n,).
        loss_time: Loss time of the elastic elements [s]: f = elastic(x) * (1 + loss_time * rate * dx/dt).
        friction: Dry friction, or None.
        noise: Standard deviation of measurements, per signal [its unit].
        rest: Joint positions at the start [rad], shape (n,).
        rest_tension: Tensions at the start [N], shape (m,).
        object_mass: Mass of the heavy object [kg].
        object_radius: Radius of the heavy object [m].
    """

    urdf: Path
    paths: Paths
    elastic: Elastic
    slack: np.ndarray
    joint_damping: np.ndarray
    loss_time: float
    friction: Friction | None
    noise: Mapping[str, float]
    rest: np.ndarray
    rest_tension: np.ndarray
    object_mass: float = 0.7
    object_radius: float = 0.05
