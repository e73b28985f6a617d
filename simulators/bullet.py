"""Rigid bodies in PyBullet: torques in, joint positions and velocities out.

This is the only file that imports pybullet. Every call names its physics client, so that worlds are independent.
"""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from simulators.chain import GRAVITY


@contextlib.contextmanager
def without_output(*descriptors: int) -> Iterator[None]:
    """Discard the output of C code to file descriptors: 1 is standard output, 2 standard error."""
    kept, sink = [os.dup(one) for one in descriptors], os.open(os.devnull, os.O_WRONLY)
    for one in descriptors:
        os.dup2(sink, one)
    try:
        yield
    finally:
        for one, copy in zip(descriptors, kept, strict=True):
            os.dup2(copy, one)
            os.close(copy)
        os.close(sink)


with without_output(2):  # pybullet prints its build time when it is imported
    import pybullet


class BulletBody:
    """A fixed-base body from a URDF, headless, whose joints are driven by torques only.

    Attributes:
        position: Joint positions [rad], shape (n,); updated in place by every step.
        velocity: Joint velocities [rad/s], shape (n,); likewise.
    """

    def __init__(self, urdf: Path, joints: Sequence[str], position: np.ndarray) -> None:
        """Load `urdf` and put its `joints`, in this order, at `position` [rad], at rest."""
        self._client = pybullet.connect(pybullet.DIRECT)
        client = {"physicsClientId": self._client}
        pybullet.setPhysicsEngineParameter(enableFileCaching=0, **client)  # a file changed on disk must be read again
        pybullet.setGravity(0.0, 0.0, -GRAVITY, **client)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        self._body = pybullet.loadURDF(str(urdf), useFixedBase=True, flags=flags, **client)
        count = pybullet.getNumJoints(self._body, **client)
        indices = {pybullet.getJointInfo(self._body, i, **client)[1].decode(): i for i in range(count)}
        self._index = indices
        self._joints = [indices[name] for name in joints]
        for index in range(-1, count):
            pybullet.changeDynamics(
                self._body, index, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, **client
            )
        self._still = [0.0] * len(self._joints)
        pybullet.setJointMotorControlArray(
            self._body, self._joints, pybullet.VELOCITY_CONTROL, forces=self._still, **client
        )
        for index, angle in zip(self._joints, position, strict=True):
            pybullet.resetJointState(self._body, index, float(angle), 0.0, **client)
        self.position = np.array(position, float)
        self.velocity = np.zeros(len(self._joints))
        self._step_size = 0.0

    def step(self, torque: np.ndarray, duration: float) -> None:
        """Advance the physics by one step of `duration` [s] under joint torques [N m], shape (n,)."""
        client = self._client
        if duration != self._step_size:
            pybullet.setTimeStep(duration, physicsClientId=client)
            self._step_size = duration
        pybullet.setJointMotorControlArray(
            self._body, self._joints, pybullet.TORQUE_CONTROL, forces=torque.tolist(), physicsClientId=client
        )
        pybullet.stepSimulation(physicsClientId=client)
        states = pybullet.getJointStates(self._body, self._joints, physicsClientId=client)
        self.position[:] = [state[0] for state in states]
        self.velocity[:] = [state[1] for state in states]

    def inertia(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix [kg m^2], shape (n, n), and the torques [N m] of gravity and velocity, shape (n,).

        These torques keep the present velocity.
        """
        client, position, velocity = self._client, self.position.tolist(), self.velocity.tolist()
        mass = pybullet.calculateMassMatrix(self._body, position, physicsClientId=client)
        bias = pybullet.calculateInverseDynamics(self._body, position, velocity, self._still, physicsClientId=client)
        return np.array(mass), np.array(bias)

    def place(self, position: np.ndarray) -> None:
        """Put the joints at `position` [rad], shape (n,), at rest: kinematics without physics."""
        for index, angle in zip(self._joints, position.tolist(), strict=True):
            pybullet.resetJointState(self._body, index, angle, 0.0, physicsClientId=self._client)
        self.position[:] = position
        self.velocity[:] = 0.0

    def frame(self, joint: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of the link behind `joint`: orientation (3, 3) and origin [m] (3,) of its frame in the
        base's.
        """
        index = self._index[joint]
        state = pybullet.getLinkState(self._body, index, computeForwardKinematics=1, physicsClientId=self._client)
        rotation = pybullet.getMatrixFromQuaternion(state[5])
        return np.array(rotation).reshape(3, 3), np.array(state[4])

    def energy(self) -> float:
        """Return the kinetic and potential energy of the links [J]."""
        joints = range(pybullet.getNumJoints(self._body, physicsClientId=self._client))
        mass, _ = self.inertia()
        states = pybullet.getLinkStates(self._body, joints, computeForwardKinematics=1, physicsClientId=self._client)
        masses = [pybullet.getDynamicsInfo(self._body, index, physicsClientId=self._client)[0] for index in joints]
        height = sum(weight * state[0][2] for weight, state in zip(masses, states, strict=True))
        return float(0.5 * self.velocity @ mass @ self.velocity + GRAVITY * height)

    def add_mass(self, joint: str, mass: float, radius: float) -> None:
        """Add a ball of `mass` [kg] and `radius` [m] at the centre of mass of the link behind `joint`."""
        index = self._index[joint]
        link_mass, _, inertia, *_ = pybullet.getDynamicsInfo(self._body, index, physicsClientId=self._client)
        added = 0.4 * mass * radius**2
        pybullet.changeDynamics(
            self._body,
            index,
            mass=link_mass + mass,
            localInertiaDiagonal=[value + added for value in inertia],
            physicsClientId=self._client,
        )

    def close(self) -> None:
        """Disconnect the physics client. Safe to call twice."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
