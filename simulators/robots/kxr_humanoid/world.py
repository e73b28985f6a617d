"""The humanoid as a World: servos that follow, and a body that is at rest wherever they are."""

import math
from collections.abc import Mapping

import numpy as np
from typing_extensions import override

from simulators.faults import UnknownPart, changed_tool, check_condition
from simulators.robots.kxr_humanoid.body import REST, Body
from simulators.robots.kxr_humanoid.eye import PIXEL, POSITION, Eye
from simulators.robots.kxr_humanoid.feet import center_of, foot_forces
from simulators.robots.kxr_humanoid.statics import rest
from simulators.world import World, servo_index

COMMAND, FORCE, CENTER = "joint_position", "foot_force", "center_of_gravity"
JOINTS = ("shoulder_pitch", "shoulder_yaw", "elbow_pitch", "ankle_pitch")

FASTEST = 7.48
"""A servo has this highest speed [rad/s]."""
LAG = 0.03
"""The position loop of a servo has this time constant [s]."""


class HumanoidWorld(World):
    """World of a low-rigidity humanoid, quasi-static: links, feet and camera are at rest for the motors' angles.

    joint_position is the motors' side, as the servos' encoders measure it; the links differ from it by deflection.
    """

    def __init__(self, body: Body, seed: int, condition: str | None = None) -> None:
        """Put the body at rest, a tool in its hand, servos without power.

        Raises:
            UnknownPart: No such condition.
        """
        self.time = 0.0
        self._body = body
        self._conditions = tuple(body.tools)
        self._tool = body.tools[str(check_condition(condition, self._conditions))]
        self._random = np.random.default_rng([seed, 12])
        self._eye = Eye(body, self._random)
        self._servos = {f"{COMMAND}.{joint}": index for index, joint in enumerate(JOINTS)}
        self._motor = REST.copy()
        self._target = REST.copy()
        self._follows = np.zeros(len(JOINTS))
        self._state: dict[str, np.ndarray] | None = None

    @override
    def step(self, duration: float) -> None:
        self.time += duration
        reach = FASTEST * duration
        move = (self._target - self._motor) * (-math.expm1(-duration / LAG))
        move = np.minimum(np.maximum(move, -reach), reach) * self._follows
        if np.abs(move).max() > _STILL:
            self._motor = self._motor + move
            self._state = None

    @override
    def measure(self) -> Mapping[str, np.ndarray]:
        values = dict(self.truth())
        for name in (COMMAND, FORCE):
            deviation = self._body.noise.get(name, 0.0)
            if deviation:
                values[name] = values[name] + deviation * self._random.standard_normal(len(values[name]))
        values[CENTER] = center_of(values[FORCE])
        return values | self._eye.see(values)

    @override
    def truth(self) -> Mapping[str, np.ndarray]:
        """Return the truth; the image point also outside of the image."""
        if self._state is None:
            state = rest(self._body, self._tool, self._motor[None])
            forces = foot_forces(state.center[0], state.weight)
            self._state = {
                COMMAND: self._motor,
                FORCE: forces,
                CENTER: center_of(forces),
                POSITION: state.tip[0],
                PIXEL: state.pixel[0],
            }
        return {name: value.copy() for name, value in self._state.items()}

    @override
    def drive(self, element: str, target: float, enabled: bool) -> None:
        """Set the target of a servo; without power it is held by the friction of its gear."""
        index = servo_index(self._servos, element, target)
        self._target[index] = target
        self._follows[index] = enabled

    @override
    def break_part(self, part: str) -> None:
        """Change the tool by `tool_changed:<condition>`, or break the camera."""
        if part.startswith("tool_changed"):
            self._tool = self._body.tools[changed_tool(part, self._conditions)]
            self._state = None
            return
        try:
            self._eye.fault(part)
        except UnknownPart as error:
            tools = ", ".join(f"tool_changed:{name}" for name in self._conditions)
            raise UnknownPart(f"{error} Tools to change to: {tools}.") from None

    @override
    def close(self) -> None:
        """Do nothing: there is no physics engine."""


_STILL = 1e-5
"""A motor that would move less than this in a step [rad] is at rest, and its state is not computed again."""
