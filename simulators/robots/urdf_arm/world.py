"""An arm from a URDF as a World: gravity, contact, elastic gears, encoders on both sides of them, and a camera."""

import math
from collections.abc import Mapping

import numpy as np
from typing_extensions import override

from hal.config import RobotConfig
from simulators.faults import UnknownPart
from simulators.physics.choice import make_arm
from simulators.physics.scene import STEP
from simulators.robots.urdf_arm.body import EFFORT, JOINT, MOTOR, TIP, Body, arm_in
from simulators.robots.urdf_arm.body_file import physics_urdf
from simulators.robots.urdf_arm.camera import TipCamera
from simulators.robots.urdf_arm.kinematics import TipKinematics
from simulators.robots.urdf_arm.survey import motor_torques, needs, neutral
from simulators.world import World, servo_index

TWIST = 0.01
"""A gear twists by this angle [rad] under the largest torque that its joint needs."""
FILTER = 0.1
"""Torques are measured with this time constant [s]."""
SMOOTH = 0.03
"""Servos smooth the steps between set-points with this time constant [s]."""


class ArmWorld(World):
    """World of an arm. Signals: motor_position, joint_position, joint_effort, tool_tip_position."""

    def __init__(self, config: RobotConfig, body: Body, seed: int) -> None:
        """Put the arm into the middle of its range, its brakes on.

        Args:
            config: The robot file, with the path of the URDF, the tip, the joints and their limits.
            body: Differences from the URDF.
            seed: Seed of the sensors' noise.
        """
        self.time = 0.0
        self._config, self._made = config, body
        arm = arm_in(config)
        self._kinematics = TipKinematics(arm)
        low, high = config.bounds(MOTOR)
        middle = 0.5 * (low + high)
        text, _ = physics_urdf(arm, dict(zip(arm.names, body.weights, strict=True)))
        self._physics = make_arm(text, arm.names, neutral(arm), np.full(middle.size, np.inf))
        self._needed = needs(self._physics, low, high)
        self._physics.limit(np.maximum(2.0 * self._needed, motor_torques(arm, self._needed)))
        self._physics.place(middle)
        self._twist = TWIST / self._needed
        self._effort = self._physics.torques(middle)[0]
        self._servos = {f"{MOTOR}.{name}": index for index, name in enumerate(arm.names)}
        self._target = middle + self._twist * self._effort
        self._held, self._reference = middle.copy(), middle.copy()
        self._follows = np.zeros(middle.size, bool)
        self._left = 0.0
        self._camera = TipCamera(arm.reach, body, seed)
        self._random = np.random.default_rng([seed, 17])

    @override
    def step(self, duration: float) -> None:
        self.time += duration
        self._left += duration
        smooth, share = (-math.expm1(-STEP / time) for time in (SMOOTH, FILTER))
        for _ in range(int(self._left / STEP + 1e-6)):
            wanted = np.where(self._follows, self._target - self._twist * self._effort, self._held)
            self._reference += smooth * (wanted - self._reference)
            self._physics.step(self._reference)
            self._effort += share * (self._physics.effort - self._effort)
            self._left -= STEP

    @override
    def measure(self) -> Mapping[str, np.ndarray]:
        """Return measurements; the tool tip is as the camera sees it."""
        values = self.truth()
        noise = self._random.standard_normal
        size = self._target.size
        for signal, error, spread in (
            (JOINT, self._made.zeros, self._made.encoder_noise),
            (EFFORT, 0.0, self._made.effort_noise * self._needed),
        ):
            if signal in values:
                values[signal] = values[signal] + error + spread * noise(size)
        return values | (self._camera.see(values) if TIP in values else {})

    @override
    def truth(self) -> dict[str, np.ndarray]:
        position = self._physics.position
        values = {
            MOTOR: position + self._twist * self._effort,
            JOINT: position.copy(),
            EFFORT: self._effort.copy(),
            TIP: self._kinematics.tips(position[None])[0],
        }
        return {name: value for name, value in values.items() if name in self._config.signals}

    @override
    def drive(self, element: str, target: float, enabled: bool) -> None:
        """Set the target of a servo; its element is its motor's position."""
        index = servo_index(self._servos, element, target)
        self._target[index] = target
        if self._follows[index] and not enabled:
            self._held[index] = self._physics.position[index]
        self._follows[index] = enabled

    @override
    def break_part(self, part: str) -> None:
        """Refuse, because no part of such an arm breaks; its sensors do."""
        nodes = ", ".join(list(self._config.devices)[:3])
        raise UnknownPart(
            f"'{part}' is no part of this arm that breaks. Its nodes can fail: sensor_silent NODE ({nodes}, ...)."
        )

    @override
    def close(self) -> None:
        self._physics.close()
