"""A fixed-base arm in PyBullet whose joints follow servos, with gravity, a floor and contact between its links."""

import itertools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from simulators.bullet import pybullet, without_output
from simulators.chain import GRAVITY
from simulators.physics.scene import FLOOR, STEP

GAIN = 0.12
"""A servo removes this share of its position error in one step; 0.02 s is the time constant."""


class BulletArm:
    """An arm from the text of a URDF, whose movable joints are all driven.

    Attributes:
        position: Joint positions [rad], shape (n,); updated in place by every step.
        effort: Torque of every motor in the last step [N m], shape (n,); updated in place.
    """

    def __init__(self, text: str, joints: Sequence[str], position: np.ndarray, efforts: np.ndarray) -> None:
        """Load the arm.

        Args:
            text: A URDF whose movable joints are `joints`.
            joints: Their names, in the order of all arrays.
            position: Where it is at the start [rad], shape (n,), at rest; links that touch there never collide.
            efforts: Largest torque of every motor [N m], shape (n,).
        """
        self._client = pybullet.connect(pybullet.DIRECT)
        client = self._options = {"physicsClientId": self._client}
        pybullet.setPhysicsEngineParameter(enableFileCaching=0, **client)
        pybullet.setGravity(0.0, 0.0, -GRAVITY, **client)
        pybullet.setTimeStep(STEP, **client)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_SELF_COLLISION
        with TemporaryDirectory() as folder:
            file = Path(folder) / "arm.urdf"
            file.write_text(text)
            sys.stdout.flush()
            with without_output(1, 2):  # it prints what it reads
                self._body = pybullet.loadURDF(str(file), useFixedBase=True, flags=flags, **client)
        infos = [pybullet.getJointInfo(self._body, index, **client) for index in range(self._count)]
        indices = {info[1].decode(): info[0] for info in infos}
        self._joints = [indices[name] for name in joints]
        self._efforts = efforts.tolist()
        self._gains, self._still = [GAIN] * len(joints), [0.0] * len(joints)
        self.position, self.effort = np.array(position, float), np.zeros(len(joints))
        for index in range(-1, self._count):
            pybullet.changeDynamics(
                self._body, index, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, **client
            )
        self.place(self.position)
        self._pairs = self._allow_contacts()
        self._floor = self._add_floor()

    @property
    def _count(self) -> int:
        return int(pybullet.getNumJoints(self._body, **self._options))

    def place(self, position: np.ndarray) -> None:
        """Put the joints at `position` [rad], shape (n,), at rest."""
        for index, angle in zip(self._joints, position.tolist(), strict=True):
            pybullet.resetJointState(self._body, index, angle, 0.0, **self._options)
        self.position[:] = position

    def step(self, targets: np.ndarray) -> None:
        """Advance by `STEP` while the servos follow targets [rad], shape (n,)."""
        client = self._options
        pybullet.setJointMotorControlArray(
            self._body, self._joints, pybullet.POSITION_CONTROL, targetPositions=targets.tolist(),
            targetVelocities=self._still, forces=self._efforts, positionGains=self._gains, **client,
        )  # fmt: skip
        pybullet.stepSimulation(**client)
        states = pybullet.getJointStates(self._body, self._joints, **client)
        self.position[:] = [state[0] for state in states]
        self.effort[:] = [state[3] for state in states]

    def limit(self, efforts: np.ndarray) -> None:
        """Set the largest torque of every motor [N m], shape (n,)."""
        self._efforts = efforts.tolist()

    def touches(self, position: np.ndarray) -> bool:
        """Whether links touch one another or the floor at joint positions [rad], shape (n,), where the arm is put."""
        self.place(position)
        pybullet.performCollisionDetection(**self._options)
        return any(contact[8] < 0.0 for contact in pybullet.getContactPoints(**self._options))

    def distance(self, position: np.ndarray, most: float) -> float:
        """Return the smallest distance between what can touch [m], at most `most`; negative where shapes overlap."""
        self.place(position)
        client, body, floor = self._options, self._body, self._floor
        near = [pybullet.getClosestPoints(body, body, most, one, other, **client) for one, other in self._pairs]
        if floor is not None:
            near += [pybullet.getClosestPoints(body, floor, most, link, **client) for link in range(self._count)]
        return min((float(point[8]) for points in near for point in points), default=most)

    def torques(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the torques that hold the arm [N m] at joint positions [rad], and the inertia of every joint [kg m2].

        All are of shape (n,).
        """
        # Bullet's own inverse dynamics refuses heavy links: their tensors must be symmetric to the last bit.
        client, kept = self._options, self.position.copy()
        before = pybullet.saveState(**client)
        self.place(position)
        states = pybullet.getLinkStates(self._body, range(self._count), computeForwardKinematics=1, **client)
        dynamics = [pybullet.getDynamicsInfo(self._body, index, **client) for index in range(self._count)]
        pybullet.restoreState(before, **client)
        pybullet.removeState(before, **client)
        self.position[:] = kept
        infos = [pybullet.getJointInfo(self._body, index, **client) for index in range(self._count)]
        torque, inertia = np.zeros(len(self._joints)), np.zeros(len(self._joints))
        for link, (state, info) in enumerate(zip(states, dynamics, strict=True)):
            mass, own = info[0], _turned(state[1]) * np.sqrt(info[2])
            for joint in self._carriers(link, infos):
                axis = _turned(states[joint][1]) @ infos[joint][13]  # Bullet gives it in the frame of the inertia
                swing = np.cross(axis, np.subtract(state[0], states[joint][4]))
                row = self._joints.index(joint)
                torque[row] += mass * GRAVITY * swing[2]
                inertia[row] += mass * (swing @ swing) + np.sum((axis @ own) ** 2)
        return torque, inertia

    def _carriers(self, link: int, infos: Sequence[tuple[Any, ...]]) -> Iterator[int]:
        """Yield the driven joints that move a link."""
        while link >= 0:
            if link in self._joints:
                yield link
            link = infos[link][16]

    def _allow_contacts(self) -> list[tuple[int, int]]:
        """Let links collide that do not touch now and are not neighbours; return their pairs."""
        client, count = self._options, self._count
        parents = {index: pybullet.getJointInfo(self._body, index, **client)[16] for index in range(count)}
        allowed = []
        for one, other in itertools.combinations(range(-1, count), 2):
            near = parents.get(other) == one or parents.get(one) == other or parents.get(parents.get(other, -1)) == one
            touching = near or pybullet.getClosestPoints(
                self._body, self._body, 0.0, linkIndexA=one, linkIndexB=other, **client
            )
            pybullet.setCollisionFilterPair(self._body, self._body, one, other, 0 if touching else 1, **client)
            if not touching:
                allowed.append((one, other))
        return allowed

    def _add_floor(self) -> int | None:
        """Add a floor below the links that stand still, if they have a shape, and below the arm; return its number."""
        shaped = [
            link for link in range(-1, self._count) if pybullet.getCollisionShapeData(self._body, link, **self._options)
        ]
        if -1 not in shaped:
            return None
        lowest = min(pybullet.getAABB(self._body, link, **self._options)[0][2] for link in shaped)
        half = [50.0, 50.0, 0.5]
        box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **self._options)
        place = [0.0, 0.0, lowest - FLOOR - half[2]]
        return int(pybullet.createMultiBody(0.0, box, basePosition=place, **self._options))

    def close(self) -> None:
        """Disconnect the physics client. Safe to call twice."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1


def _turned(quaternion: Sequence[float]) -> np.ndarray:
    """Return the rotation matrix of Bullet's quaternion, shape (3, 3)."""
    return np.array(pybullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
