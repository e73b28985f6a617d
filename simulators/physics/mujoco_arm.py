"""A fixed-base arm in MuJoCo whose joints follow servos, as `simulators.physics.bullet_arm` in PyBullet."""

import itertools
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import mujoco
import numpy as np

from simulators.chain import GRAVITY
from simulators.physics.mujoco_body import Joints, with_compiler
from simulators.physics.scene import FLOOR, STEP

STIFFNESS = 50.0
"""A servo is critically damped with this frequency [rad/s]; its time constant is 0.02 s."""
PLANE = "floor"


class MujocoArm:
    """An arm from the text of a URDF, whose movable joints are all driven.

    Attributes:
        position: Joint positions [rad], shape (n,); updated in place by every step.
        effort: Torque of every motor in the last step [N m], shape (n,); updated in place.
    """

    def __init__(self, text: str, joints: Sequence[str], position: np.ndarray, efforts: np.ndarray) -> None:
        """Load the arm; the arguments are those of `simulators.physics.choice.make_arm`."""
        self._efforts = efforts.copy()
        self.position, self.effort = np.array(position, float), np.zeros(len(joints))
        source = with_compiler(ElementTree.fromstring(text))
        spec = mujoco.MjSpec.from_string(source)
        self._load(spec, joints)
        touching, low = self._touching(), self._lowest()
        spec = mujoco.MjSpec.from_string(source)
        for one, other in touching:
            spec.add_exclude(bodyname1=one, bodyname2=other)
        if low is not None:
            spec.worldbody.add_geom(
                name=PLANE, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[50.0, 50.0, 1.0], pos=[0.0, 0.0, low - FLOOR]
            )
        self._load(spec, joints)

    def _load(self, spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
        self._model = spec.compile()
        self._model.opt.timestep = STEP
        self._model.opt.gravity[:] = (0.0, 0.0, -GRAVITY)
        self._model.dof_damping[:] = self._model.dof_frictionloss[:] = 0.0
        self._data = mujoco.MjData(self._model)
        self._joints = Joints(self._model, joints)
        self.place(self.position.copy())

    def _touching(self) -> list[tuple[str, str]]:
        """Return the pairs of links that touch now or are neighbours, or neighbours of a neighbour."""
        model, data = self._model, self._data
        names = [model.body(index).name for index in range(model.nbody)]
        parent = [int(model.body_parentid[index]) for index in range(model.nbody)]
        pairs = []
        for one, other in itertools.combinations(range(model.nbody), 2):
            near = one in (parent[other], parent[parent[other]])
            shapes = [[g for g in range(model.ngeom) if model.geom_bodyid[g] == body] for body in (one, other)]
            apart = (mujoco.mj_geomDistance(model, data, a, b, 0.01, None) for a in shapes[0] for b in shapes[1])
            if near or any(distance <= 0.0 for distance in apart):
                pairs.append((names[one], names[other]))
        return pairs

    def _lowest(self) -> float | None:
        """Return the lowest place of all shapes [m]; None if what stands still has none."""
        model, data = self._model, self._data
        if not (model.geom_bodyid == 0).any():
            return None
        lows = []
        for geom in range(model.ngeom):
            center, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
            turn = data.geom_xmat[geom].reshape(3, 3)
            lows.append(float(data.geom_xpos[geom][2] + turn[2] @ center - np.abs(turn[2]) @ half))
        return min(lows)

    def place(self, position: np.ndarray) -> None:
        """Put the joints at `position` [rad], shape (n,), at rest."""
        self._data.qpos[self._joints.place] = position
        self._data.qvel[:] = 0.0
        mujoco.mj_forward(self._model, self._data)
        self.position[:] = position

    def step(self, targets: np.ndarray) -> None:
        """Advance by `STEP` while the servos follow targets [rad], shape (n,)."""
        data, speed = self._data, self._joints.speed
        error = targets - data.qpos[self._joints.place]
        wanted = STIFFNESS**2 * error - 2.0 * STIFFNESS * data.qvel[speed]
        torque = self._joints.times_mass(self._model, data, wanted) + data.qfrc_bias[speed]
        self.effort[:] = np.clip(torque, -self._efforts, self._efforts)
        data.qfrc_applied[speed] = self.effort
        mujoco.mj_step(self._model, data)
        self.position[:] = data.qpos[self._joints.place]

    def limit(self, efforts: np.ndarray) -> None:
        """Set the largest torque of every motor [N m], shape (n,)."""
        self._efforts = efforts.copy()

    def touches(self, position: np.ndarray) -> bool:
        """Whether links touch one another or the floor at joint positions [rad], shape (n,), where the arm is put."""
        return self.distance(position, 0.0) < 0.0

    def distance(self, position: np.ndarray, most: float) -> float:
        """Return the smallest distance between what can touch [m], at most `most`; negative where shapes overlap."""
        self._model.geom_margin[:] = most
        self.place(position)
        self._model.geom_margin[:] = 0.0
        return float(np.min(self._data.contact.dist[: self._data.ncon], initial=most))

    def torques(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the torques that hold the arm [N m] at joint positions [rad], and the inertia of every joint [kg m2].

        All are of shape (n,).
        """
        kept = self.position.copy()
        self.place(position)
        torque = self._data.qfrc_bias[self._joints.speed].copy()
        inertia = np.diag(self._joints.matrix(self._model, self._data)).copy()
        self.place(kept)
        return torque, inertia

    def close(self) -> None:
        """Do nothing: MuJoCo frees its memory by itself."""
