"""A muscle-driven body as a World: rigid links in PyBullet; wires, elastic elements, spool servos and friction
in compiled loops; sensors in numpy.

The length of a wire is the length that the spool has released. The path is longer by the elongation of the elastic
element. The load cell is at the spool. Because of friction between spool and elastic element, the load cell reads more
than the tension of the elastic element after the wire was wound in, and less after it was released. The moment arms
convert the tensions of the elastic elements to joint torques, tau = -G^T f, once per physics step. Wires are stiff and
a forearm is light, so steps are linearly implicit: they use the tensions at the end of the step.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np
from typing_extensions import override

from simulators.faults import MUSCLE_CUT, check_part
from simulators.muscle_body import Body, Friction, Servo
from simulators.muscle_kernels import held, pull
from simulators.physics.choice import make_body
from simulators.world import World, servo_index


class MuscleWorld(World):
    """World of a muscle-driven body. Signals: joint_position, muscle_tension, muscle_length."""

    _STEPS_PER_REFRESH = 2
    """Moment arms and inertia are solved every this many steps; in between, paths are linear in joint positions."""

    def __init__(self, body: Body, seed: int, servo: Servo | None = None, longest_step: float = 0.0025) -> None:
        """Create the body at rest, with the brakes on.

        Args:
            body: Parts of the body.
            seed: Seed of the sensors' noise.
            servo: Limits of the spool servos.
            longest_step: Longest step of the physics [s]. With the default, random motion differs from that with
                a ten times shorter step by 0.001 rad and 0.5 N (root mean square).
        """
        self.time = 0.0
        self.push: Callable[[np.ndarray], np.ndarray] | None = None
        """It returns the joint torques of contacts [N m] at joint positions [rad], both of shape (n,)."""
        self._longest_step = longest_step
        self._body = body
        self._servo = servo or Servo()
        joints, muscles = body.paths.chain.joints, body.paths.names
        self._physics = make_body(body.urdf, joints, body.rest)
        self._random = np.random.default_rng(seed)
        self._muscles = {f"muscle_length.{name}": index for index, name in enumerate(muscles)}
        self._noise = {
            "joint_position": (body.noise.get("joint_position", 0.0), len(joints)),
            "muscle_tension": (body.noise.get("muscle_tension", 0.0), len(muscles)),
            "muscle_length": (body.noise.get("muscle_length", 0.0), len(muscles)),
        }
        self._wires = np.zeros((5, len(muscles)))
        self._spool, self._pull, self._tension = self._wires[:3]
        self._orders = np.zeros((4, len(muscles)))
        self._target, self._follows, self._grip, self._whole = self._orders
        self._slid_joint = np.zeros(len(joints))
        self._build, self._joints, self._numbers = _constants(body, self._servo)
        self._pull[:] = self._tension[:] = body.rest_tension
        self._refresh(self._longest_step)
        self._spool[:] = self._target[:] = self._lengths - body.elastic.elongation(body.rest_tension)
        self._hold_or_drive()
        self._whole[:] = 1.0
        self._pulled(longest_step, self._wires.copy(), self._slid_joint.copy())  # compile now, not in the first step

    @override
    def step(self, duration: float) -> None:
        count = max(1, math.ceil(duration / self._longest_step - 1e-6))
        size = duration / count
        for index in range(count):
            if index % self._STEPS_PER_REFRESH == 0:
                self._refresh(size)
            self._substep(size)
        self.time += duration

    @override
    def measure(self) -> Mapping[str, np.ndarray]:
        values = self.truth()
        for name, (deviation, size) in self._noise.items():
            if deviation:
                values[name] += deviation * self._random.standard_normal(size)
        return values

    @override
    def truth(self) -> dict[str, np.ndarray]:
        return {
            "joint_position": self._physics.position.copy(),
            "muscle_tension": self._tension.copy(),
            "muscle_length": self._spool - self._body.slack,
        }

    @override
    def drive(self, element: str, target: float, enabled: bool) -> None:
        """Set the target of a servo; its element is its muscle's length."""
        index = servo_index(self._muscles, element, target, "a length in metres")
        self._target[index] = target + self._body.slack[index]
        if self._follows[index] != enabled:
            self._follows[index] = enabled
            self._hold_or_drive()

    @override
    def break_part(self, part: str) -> None:
        """Break `muscle_cut:<muscle>`, or add `heavy_object`."""
        kind, muscle = check_part(part, self._body.paths.names)
        if kind == MUSCLE_CUT:
            self._whole[self._body.paths.names.index(muscle)] = 0.0
        else:
            hand = self._body.paths.chain.joints[-1]
            self._physics.add_mass(hand, self._body.object_mass, self._body.object_radius)

    @override
    def close(self) -> None:
        self._physics.close()

    def _refresh(self, duration: float) -> None:
        """Solve the paths at the present posture, and the matrix for implicit steps of `duration` [s].

        With joint stiffness K and damping D, (M + D dt + K dt^2) dv = (tau - bias) dt. PyBullet gets the torque that
        gives the same dv with M alone.
        """
        body = self._body
        self._solved_at = self._physics.position.copy()
        self._lengths, self._arms = body.paths.solve(self._solved_at)
        mass, self._bias = self._physics.inertia()
        elastic = body.elastic.stiffness(self._pull) * duration**2
        viscous = body.loss_time * body.elastic.rate * self._pull * duration
        slope = self._joints[1] / self._numbers[-1] * duration**2  # of dry friction before it slips
        resisted = mass + held(self._arms, elastic + viscous, body.joint_damping * duration + slope)
        self._implicit = np.linalg.solve(resisted, mass).T

    def _hold_or_drive(self) -> None:
        """Compute the largest elongation of each elastic element [m], at which its motor or its brake slips."""
        force = np.where(self._follows > 0, self._servo.force, self._servo.brake)
        self._grip[:] = self._body.elastic.elongation(force)

    def _substep(self, duration: float) -> None:
        torque = self._pulled(duration, self._wires, self._slid_joint)
        if self.push is not None:
            torque = torque + self.push(self._physics.position)
        self._physics.step(self._bias + self._implicit @ (torque - self._bias), duration)

    def _pulled(self, duration: float, wires: np.ndarray, slid_joint: np.ndarray) -> np.ndarray:
        """Advance wires and sliding joints by one step; return the torques [N m], shape (n,)."""
        torque: np.ndarray = pull(
            duration, self._physics.position, self._physics.velocity, self._solved_at, self._lengths, self._arms,
            wires, self._orders, self._build, slid_joint, self._joints, self._numbers,
        )  # fmt: skip
        return torque


def _constants(body: Body, servo: Servo) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the constants of wires, joints and spools for `pull`; shapes (4, m), (2, n), (6,)."""
    muscles, joints = len(body.paths.names), len(body.paths.chain.joints)
    smooth = Friction(np.zeros(joints), 1.0, np.zeros(muscles), 1.0, np.zeros(muscles), 1.0)
    dry = body.friction or smooth
    build = np.empty((4, muscles))
    build[0], build[1], build[2], build[3] = body.elastic.scale, body.elastic.rate, dry.wire, dry.guide
    numbers = (servo.speed, servo.lag, body.loss_time, dry.wire_presliding, dry.guide_presliding, dry.joint_presliding)
    return build, np.array([body.joint_damping, dry.joint_torque]), np.array(numbers)
