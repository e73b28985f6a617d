"""The arm and its duster as a World: joints that follow their set-points, a hand where PyBullet has it, cloth at rest.

Motion is slow beside the arm's own dynamics, whose weight springs carry; so joints follow kinematically, and the duster
is where it comes to rest.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from typing_extensions import override

from simulators.faults import changed_tool, check_condition
from simulators.physics.choice import make_body
from simulators.robots.pr2_duster.body import FASTEST, LAG, REST, URDF, Body, chain
from simulators.robots.pr2_duster.camera import SIGNAL, DepthCamera
from simulators.robots.pr2_duster.duster import GRASPS, Grasp
from simulators.world import World, servo_index


class DusterWorld(World):
    """World of an arm that holds a duster. Signals: joint_position, tool_tip_position."""

    def __init__(self, body: Body, seed: int, condition: str | None = None) -> None:
        """Put the arm at rest, its brakes on, with a duster in its hand.

        Args:
            body: What it is made of.
            seed: Seed of the sensors' noise and of the position of the duster in the hand.
            condition: The grasp; the body's own if not given.

        Raises:
            UnknownPart: The grasp is not known.
        """
        check_condition(condition, tuple(GRASPS))
        self.time = 0.0
        self._body = body
        self._camera = DepthCamera(body, seed)
        self._random = np.random.default_rng([seed, 13])
        self._position = REST.copy()
        self._target = REST.copy()
        self._follows = np.zeros(len(REST))
        self._low, self._high = chain().low, chain().high
        self._hand = chain().joints[-1]
        self._servos = {f"joint_position.{name}": index for index, name in enumerate(chain().joints)}
        self._grasp = self._gripped(condition or body.condition)
        self._physics = make_body(URDF, chain().joints, REST)

    @override
    def step(self, duration: float) -> None:
        reach = FASTEST * duration
        move = (self._target - self._position) * -math.expm1(-duration / LAG)
        self._position += np.minimum(np.maximum(move, -reach), reach) * self._follows
        np.minimum(np.maximum(self._position, self._low, out=self._position), self._high, out=self._position)
        self.time += duration

    @override
    def measure(self) -> Mapping[str, np.ndarray]:
        """Return measurements; the tool tip is as the camera sees it."""
        values = self.truth()
        if self._body.encoder_noise:
            values["joint_position"] += self._body.encoder_noise * self._random.standard_normal(len(REST))
        return values | self._camera.see(values)

    @override
    def truth(self) -> dict[str, np.ndarray]:
        """Return the truth; joint positions are those of ideal encoders with these zeros."""
        self._physics.place(self._position)
        rotation, origin = self._physics.frame(self._hand)
        tip = self._grasp.cloth(rotation[None], (origin + rotation @ self._body.grip)[None])[0]
        return {"joint_position": self._position - self._body.zero, SIGNAL: tip}

    @override
    def drive(self, element: str, target: float, enabled: bool) -> None:
        """Set the target of a servo; its element is its joint's position."""
        index = servo_index(self._servos, element, target)
        self._target[index] = target + self._body.zero[index]
        self._follows[index] = enabled

    @override
    def break_part(self, part: str) -> None:
        """Change the tool: `tool_changed:<condition>`."""
        self._grasp = self._gripped(changed_tool(part, tuple(GRASPS)))

    @override
    def close(self) -> None:
        self._physics.close()

    def _gripped(self, condition: str) -> Grasp:
        meant, body = GRASPS[condition], self._body
        if not body.rough_length:
            return meant
        length, angle = self._random.standard_normal(2) * (body.rough_length, body.rough_angle)
        return replace(meant, length=meant.length + length, angle=meant.angle + angle)
