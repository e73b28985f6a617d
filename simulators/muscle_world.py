"""A muscle-driven body as a World: rigid links in PyBullet, wires, elastic elements, spool servos and sensors in numpy.

A wire's length is what its spool has paid out; the path is longer by what the elastic element gives. The load cell sits
at the spool: friction on the way makes it read more than the elastic element carries when the wire was last wound in,
and less when it was paid out. Tensions of the elastic elements are brought to the joints by the moment arms,
tau = -G^T f, once per physics step. Wires are stiff and a forearm is light, so steps are linearly implicit: tensions
are taken where the joints will be at the end of the step.
"""

import math
from collections.abc import Mapping

import numpy as np

from simulators.bullet import BulletBody
from simulators.faults import MUSCLE_CUT, check_part
from simulators.muscle_body import Body, Friction, Servo


class MuscleWorld:
    """See `simulators.world.World`. Signals: joint_position, muscle_tension, muscle_length."""

    _STEPS_PER_REFRESH = 2
    """Moment arms and inertia are solved anew every so many steps; in between paths are linear in joint positions."""

    def __init__(self, body: Body, seed: int, servo: Servo | None = None, longest_step: float = 0.0025) -> None:
        """Put the body at rest, its brakes on.

        Args:
            body: What it is made of.
            seed: Of the sensors' noise.
            servo: What its spools can do.
            longest_step: Of the physics [s]; with the default, random motion differs from a ten times finer one by
                0.001 rad and 0.5 N (root mean square).
        """
        self.time = 0.0
        self._longest_step = longest_step
        self._body = body
        self._servo = servo or Servo()
        joints, muscles = body.paths.chain.joints, body.paths.names
        self._bullet = BulletBody(body.urdf, joints, body.rest)
        self._diagonal = np.diag_indices(len(joints))
        self._random = np.random.default_rng(seed)
        self._muscles = {f"muscle_length.{name}": index for index, name in enumerate(muscles)}
        self._noise = {
            "joint_position": (body.noise.get("joint_position", 0.0), len(joints)),
            "muscle_tension": (body.noise.get("muscle_tension", 0.0), len(muscles)),
            "muscle_length": (body.noise.get("muscle_length", 0.0), len(muscles)),
        }
        self._pull = body.rest_tension.copy()
        self._tension = body.rest_tension.copy()
        self._refresh(self._longest_step)
        self._spool = self._lengths - body.elastic.elongation(body.rest_tension)
        self._target = self._spool.copy()
        self._follows = np.zeros(len(muscles))
        self._grip = np.empty(len(muscles))
        self._hold_or_drive()
        self._whole = np.ones(len(muscles))
        self._slid_joint = np.zeros(len(joints))
        self._slid_wire = np.zeros(len(muscles))
        self._slid_guide = np.zeros(len(muscles))

    def step(self, duration: float) -> None:
        """See `World.step`."""
        count = max(1, math.ceil(duration / self._longest_step - 1e-6))
        size = duration / count
        for index in range(count):
            if index % self._STEPS_PER_REFRESH == 0:
                self._refresh(size)
            self._substep(size)
        self.time += duration

    def measure(self) -> Mapping[str, np.ndarray]:
        """See `World.measure`."""
        values = self.truth()
        for name, (deviation, size) in self._noise.items():
            if deviation:
                values[name] += deviation * self._random.standard_normal(size)
        return values

    def truth(self) -> dict[str, np.ndarray]:
        """See `World.truth`."""
        return {
            "joint_position": self._bullet.position.copy(),
            "muscle_tension": self._tension.copy(),
            "muscle_length": self._spool - self._body.slack,
        }

    def drive(self, element: str, target: float, enabled: bool) -> None:
        """See `World.drive`; the element of a servo is its muscle's length."""
        index = self._muscles.get(element)
        if index is None:
            raise KeyError(f"No servo moves '{element}'. Known servos: {', '.join(self._muscles)}.")
        if not math.isfinite(target):
            raise ValueError(f"The set-point of '{element}' is {target}; it must be a length in metres.")
        self._target[index] = target + self._body.slack[index]
        if self._follows[index] != enabled:
            self._follows[index] = enabled
            self._hold_or_drive()

    def break_part(self, part: str) -> None:
        """See `World.break_part`: `muscle_cut:<muscle>` or `heavy_object`."""
        kind, muscle = check_part(part, self._body.paths.names)
        if kind == MUSCLE_CUT:
            self._whole[self._body.paths.names.index(muscle)] = 0.0
        else:
            hand = self._body.paths.chain.joints[-1]
            self._bullet.add_mass(hand, self._body.object_mass, self._body.object_radius)

    def close(self) -> None:
        """See `World.close`."""
        self._bullet.close()

    def _refresh(self, duration: float) -> None:
        """Solve the paths at the present posture, and what makes steps of `duration` [s] implicit.

        With joint stiffness K and damping D at hand, (M + D dt + K dt^2) dv = (tau - bias) dt; PyBullet gets the torque
        that makes M dv of it.
        """
        body = self._body
        self._solved_at = self._bullet.position.copy()
        self._lengths, self._arms = body.paths.solve(self._solved_at)
        mass, self._bias = self._bullet.inertia()
        elastic = body.elastic.stiffness(self._pull) * duration**2
        viscous = body.loss_time * body.elastic.rate * self._pull * duration
        held = (self._arms.T * (elastic + viscous)) @ self._arms
        held[self._diagonal] += body.joint_damping * duration
        if body.friction is not None:
            held[self._diagonal] += body.friction.joint_torque / body.friction.joint_presliding * duration**2
        self._implicit = np.linalg.solve(mass + held, mass).T

    def _hold_or_drive(self) -> None:
        """The longest a wire's elastic element can get before its motor, or its brake, gives way [m]."""
        force = np.where(self._follows > 0, self._servo.force, self._servo.brake)
        self._grip = self._body.elastic.elongation(force)

    def _substep(self, duration: float) -> None:
        body, servo, bullet = self._body, self._servo, self._bullet
        ahead = bullet.position - self._solved_at + duration * bullet.velocity
        path = self._lengths + self._arms @ ahead
        path_rate = self._arms @ bullet.velocity

        reach = servo.speed * duration
        move = (self._target - self._spool) * (duration / (duration + servo.lag))
        move = np.minimum(np.maximum(move, -reach), reach) * self._follows
        spool = np.maximum(self._spool + move, path - self._grip)

        paid_out = spool - self._spool
        stretch_rate = path_rate - paid_out / duration
        self._spool = spool
        loss = 1.0 + body.loss_time * body.elastic.rate * stretch_rate
        loss = np.minimum(np.maximum(loss, 0.0), 1.5)
        self._pull = self._tension = pull = body.elastic.tension(path - spool) * loss * self._whole

        torque = -body.joint_damping * bullet.velocity
        if body.friction is not None:
            self._tension = pull * (1.0 - self._guide_friction(body.friction, paid_out))
            pull = pull * (1.0 + self._wire_friction(body.friction, path_rate * duration))
            torque -= self._joint_friction(body.friction, bullet.velocity * duration)
        torque -= pull @ self._arms
        bullet.step(self._bias + self._implicit @ (torque - self._bias), duration)

    def _wire_friction(self, friction: Friction, travel: np.ndarray) -> np.ndarray:
        """Share of the tension by which a wire pulls harder where it is dragged out, shape (m,)."""
        limit = friction.wire_presliding
        self._slid_wire = np.minimum(np.maximum(self._slid_wire + travel, -limit), limit)
        return friction.wire * self._slid_wire / limit

    def _guide_friction(self, friction: Friction, paid_out: np.ndarray) -> np.ndarray:
        """Share of the tension that the load cell does not see, shape (m,); negative where it sees more."""
        limit = friction.guide_presliding
        self._slid_guide = np.minimum(np.maximum(self._slid_guide + paid_out, -limit), limit)
        return friction.guide * self._slid_guide / limit

    def _joint_friction(self, friction: Friction, travel: np.ndarray) -> np.ndarray:
        """Torque [N m] against the motion, shape (n,)."""
        limit = friction.joint_presliding
        self._slid_joint = np.minimum(np.maximum(self._slid_joint + travel, -limit), limit)
        return friction.joint_torque * self._slid_joint / limit
