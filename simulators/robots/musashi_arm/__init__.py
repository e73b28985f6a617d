"""A Musashi-like arm: five joints, ten muscles of which one spans both (paper, section III-B)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from simulators.faults import check_condition
from simulators.robots.musashi_arm.body import VARIANTS, make_body
from simulators.robots.musashi_arm.hardware import hardware
from simulators.robots.musashi_arm.model import force_torque, gravity_torque
from simulators.robots.musashi_arm.motion import random_motion, random_states

if TYPE_CHECKING:
    from hal.config import RobotConfig
    from hal.robot import Robot
    from simulators.muscle_world import MuscleWorld
    from simulators.rig import Rig

__all__ = ["MusashiArm", "force_torque", "gravity_torque", "hardware", "random_motion", "random_states", "simulator"]


class MusashiArm:
    """Simulator of the arm. PyBullet is imported when the first world is made."""

    variants = VARIANTS
    conditions: tuple[str, ...] = ()

    def world(self, variant: str, seed: int, condition: str | None = None) -> MuscleWorld:
        """Return the physics of one variant; the seed chooses among actual arms, and their noise."""
        from simulators.muscle_world import MuscleWorld

        check_condition(condition, self.conditions)
        return MuscleWorld(make_body(variant, seed), seed)

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """Return the world behind simulated nodes on the robot file's buses."""
        from simulators.rig import Rig

        return Rig(config, self.world(variant, seed, condition), hardware())

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """Return the world without a bus, as fast as it computes."""
        return self.without_bus(config, self.world(variant, seed, condition))

    def without_bus(self, config: RobotConfig, world: MuscleWorld) -> Robot:
        """Return the robot without a bus for a world of the caller, who may break parts of it."""
        from simulators.direct import direct_robot

        return direct_robot(config, world)


simulator = MusashiArm()
