"""A Musashi-like arm: five joints, ten muscles of which one spans both (paper, section III-B)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from typing_extensions import override

from simulators.faults import check_condition
from simulators.robots.musashi_arm.body import VARIANTS, make_body
from simulators.robots.musashi_arm.hardware import hardware
from simulators.robots.musashi_arm.model import force_torque, gravity_torque
from simulators.robots.musashi_arm.motion import random_motion, random_states
from simulators.robots.simulator import RobotSimulator

if TYPE_CHECKING:
    from simulators.muscle_world import MuscleWorld

__all__ = ["MusashiArm", "force_torque", "gravity_torque", "hardware", "random_motion", "random_states", "simulator"]


class MusashiArm(RobotSimulator):
    """Simulator of the arm. PyBullet is imported when the first world is made."""

    variants = VARIANTS
    conditions: tuple[str, ...] = ()

    @override
    def world(self, variant: str, seed: int, condition: str | None = None) -> MuscleWorld:
        from simulators.muscle_world import MuscleWorld

        check_condition(condition, self.conditions)
        return MuscleWorld(make_body(variant, seed), seed)


simulator = MusashiArm(hardware)
