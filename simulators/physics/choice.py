"""Choice of the engine: that of the robot file, else PyBullet if it is installed, else MuJoCo."""

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Protocol

import numpy as np

MODULES = {"bullet": "pybullet", "mujoco": "mujoco"}
"""Each engine is this module."""
_CHOSEN: ContextVar[str | None] = ContextVar("physics", default=None)


class RigidBody(Protocol):
    """Fixed-base body from a URDF whose joints are driven by torques only.

    Attributes:
        position: Joint positions [rad], shape (n,); updated in place by every step.
        velocity: Joint velocities [rad/s], shape (n,); likewise.
    """

    position: np.ndarray
    velocity: np.ndarray

    def step(self, torque: np.ndarray, duration: float) -> None:
        """Advance the physics by one step of `duration` [s] under joint torques [N m], shape (n,)."""
        ...

    def inertia(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix [kg m^2], shape (n, n), and the torques [N m] that keep the velocity, shape (n,)."""
        ...

    def place(self, position: np.ndarray) -> None:
        """Put the joints at `position` [rad], shape (n,), at rest: kinematics without physics."""
        ...

    def frame(self, joint: str) -> tuple[np.ndarray, np.ndarray]:
        """Return orientation (3, 3) and origin [m] (3,) of the link behind `joint` in the base's frame."""
        ...

    def energy(self) -> float:
        """Return the kinetic and potential energy of the links [J]."""
        ...

    def add_mass(self, joint: str, mass: float, radius: float) -> None:
        """Add a ball of `mass` [kg] and `radius` [m] at the centre of mass of the link behind `joint`."""
        ...

    def close(self) -> None:
        """Release the engine. Safe to call twice."""
        ...


class ServoArm(Protocol):
    """Arm whose joints follow servos, with gravity, a floor and contact between its links.

    Attributes:
        position: Joint positions [rad], shape (n,); updated in place by every step.
        effort: Torque of every motor in the last step [N m], shape (n,); updated in place.
    """

    position: np.ndarray
    effort: np.ndarray

    def place(self, position: np.ndarray) -> None:
        """Put the joints at `position` [rad], shape (n,), at rest."""
        ...

    def step(self, targets: np.ndarray) -> None:
        """Advance by `STEP` while the servos follow targets [rad], shape (n,)."""
        ...

    def limit(self, efforts: np.ndarray) -> None:
        """Set the largest torque of every motor [N m], shape (n,)."""
        ...

    def touches(self, position: np.ndarray) -> bool:
        """Whether links touch one another or the floor at joint positions [rad], shape (n,), where the arm is put."""
        ...

    def distance(self, position: np.ndarray, most: float) -> float:
        """Return the smallest distance between what can touch [m], at most `most`; negative where shapes overlap.

        The arm is put at joint positions [rad], shape (n,).
        """
        ...

    def torques(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the torques that hold the arm [N m] at joint positions [rad], and the joints' inertia [kg m2]."""
        ...

    def close(self) -> None:
        """Release the engine. Safe to call twice."""
        ...


@contextmanager
def using(engine: str | None) -> Iterator[None]:
    """Make worlds with this engine; None leaves the choice to what is installed."""
    token = _CHOSEN.set(engine)
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def engine() -> str:
    """Return the engine of the next world.

    Raises:
        ModuleNotFoundError: No engine is installed, or not the one that was chosen.
    """
    chosen = _CHOSEN.get()
    for name in (chosen,) if chosen else MODULES:
        if importlib.util.find_spec(MODULES[name]) is not None:
            return name
    module = MODULES[chosen or "bullet"]
    raise ModuleNotFoundError(f"No module named '{module}'", name=module)


def make_body(urdf: Path, joints: Sequence[str], position: np.ndarray) -> RigidBody:
    """Return a body from a URDF with its `joints`, in this order, at `position` [rad], at rest."""
    if engine() == "mujoco":
        from simulators.physics.mujoco_body import MujocoBody

        return MujocoBody(urdf, joints, position)
    from simulators.bullet import BulletBody

    return BulletBody(urdf, joints, position)


def make_arm(text: str, joints: Sequence[str], position: np.ndarray, efforts: np.ndarray) -> ServoArm:
    """Return an arm from the text of a URDF whose movable joints are `joints`.

    Args:
        text: The URDF.
        joints: Names of its movable joints, in the order of all arrays.
        position: Where it is at the start [rad], shape (n,), at rest; links that touch there never collide.
        efforts: Largest torque of every motor [N m], shape (n,).
    """
    if engine() == "mujoco":
        from simulators.physics.mujoco_arm import MujocoArm

        return MujocoArm(text, joints, position, efforts)
    from simulators.physics.bullet_arm import BulletArm

    return BulletArm(text, joints, position, efforts)
