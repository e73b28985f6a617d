"""Rigid bodies in MuJoCo: torques in, joint positions and velocities out, as `simulators.bullet` in PyBullet."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np

from simulators.chain import GRAVITY


def with_compiler(root: Element, folder: Path | None = None) -> str:
    """Return the text of a URDF with the settings by which MuJoCo reads it as Bullet does; meshes are in `folder`."""
    settings = {"discardvisual": "true", "strippath": "false", "balanceinertia": "true", "boundmass": "1e-6"}
    if folder is not None:
        settings["meshdir"] = str(folder)
    SubElement(SubElement(root, "mujoco"), "compiler", settings)
    return ElementTree.tostring(root, encoding="unicode")


class Joints:
    """Addresses of named joints in a model.

    Attributes:
        place: Address of every position, shape (n,).
        speed: Address of every velocity, shape (n,).
    """

    def __init__(self, model: mujoco.MjModel, names: Sequence[str]) -> None:
        joints = [model.joint(name) for name in names]
        self.place = np.array([int(joint.qposadr[0]) for joint in joints])
        self.speed = np.array([int(joint.dofadr[0]) for joint in joints])
        self.body = {name: int(joint.bodyid[0]) for name, joint in zip(names, joints, strict=True)}

    def matrix(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """Return the mass matrix of the joints [kg m^2], shape (n, n)."""
        columns = [self.times_mass(model, data, unit) for unit in np.eye(len(self.speed))]
        return np.stack(columns, axis=1)

    def times_mass(self, model: mujoco.MjModel, data: mujoco.MjData, acceleration: np.ndarray) -> np.ndarray:
        """Return the mass matrix times accelerations of the joints [rad/s^2]: torques [N m]; both of shape (n,)."""
        whole, result = np.zeros(model.nv), np.zeros(model.nv)
        whole[self.speed] = acceleration
        mujoco.mj_mulM(model, data, result, whole)  # mj_fullM has other arguments in every major version
        return result[self.speed]


class MujocoBody:
    """A fixed-base body from a URDF, whose joints are driven by torques only.

    Attributes:
        position: Joint positions [rad], shape (n,); updated in place by every step.
        velocity: Joint velocities [rad/s], shape (n,); likewise.
    """

    def __init__(self, urdf: Path, joints: Sequence[str], position: np.ndarray) -> None:
        """Load `urdf` and put its `joints`, in this order, at `position` [rad], at rest."""
        text = with_compiler(ElementTree.parse(urdf).getroot(), urdf.resolve().parent)
        self._model = mujoco.MjModel.from_xml_string(text)
        self._model.opt.gravity[:] = (0.0, 0.0, -GRAVITY)
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self._model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        self._model.dof_damping[:] = self._model.dof_frictionloss[:] = 0.0
        self._data = mujoco.MjData(self._model)
        self._joints = Joints(self._model, joints)
        self.position = np.array(position, float)
        self.velocity = np.zeros(len(joints))
        self.place(self.position.copy())

    def step(self, torque: np.ndarray, duration: float) -> None:
        """Advance the physics by one step of `duration` [s] under joint torques [N m], shape (n,)."""
        self._model.opt.timestep = duration
        self._data.qfrc_applied[self._joints.speed] = torque
        mujoco.mj_step(self._model, self._data)
        self.position[:] = self._data.qpos[self._joints.place]
        self.velocity[:] = self._data.qvel[self._joints.speed]

    def inertia(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix [kg m^2], shape (n, n), and the torques [N m] of gravity and velocity, shape (n,).

        These torques keep the present velocity.
        """
        self._data.qpos[self._joints.place] = self.position
        self._data.qvel[self._joints.speed] = self.velocity
        mujoco.mj_forward(self._model, self._data)
        return self._joints.matrix(self._model, self._data), self._data.qfrc_bias[self._joints.speed].copy()

    def place(self, position: np.ndarray) -> None:
        """Put the joints at `position` [rad], shape (n,), at rest: kinematics without physics."""
        self._data.qpos[self._joints.place] = position
        self._data.qvel[:] = 0.0
        mujoco.mj_forward(self._model, self._data)
        self.position[:] = position
        self.velocity[:] = 0.0

    def frame(self, joint: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of the link behind `joint`: orientation (3, 3) and origin [m] (3,) in the base's frame."""
        body = self._joints.body[joint]
        return self._data.xmat[body].reshape(3, 3).copy(), self._data.xpos[body].copy()

    def energy(self) -> float:
        """Return the kinetic and potential energy of the links [J]."""
        self.inertia()
        return float(self._data.energy.sum())

    def add_mass(self, joint: str, mass: float, radius: float) -> None:
        """Add a ball of `mass` [kg] and `radius` [m] at the centre of mass of the link behind `joint`."""
        body = self._joints.body[joint]
        self._model.body_mass[body] += mass
        self._model.body_inertia[body] += 0.4 * mass * radius**2
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))

    def close(self) -> None:
        """Do nothing: MuJoCo frees its memory by itself."""
