"""A PR2's arm with a duster in its hand (paper, section III-A): seven joints, and a camera that sees the cloth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from simulators.faults import check_condition
from simulators.robots.pr2_duster.body import VARIANTS, make_body, tool_tip
from simulators.robots.pr2_duster.camera import SIGNAL, DepthCamera
from simulators.robots.pr2_duster.duster import GRASPS
from simulators.robots.pr2_duster.hardware import hardware

if TYPE_CHECKING:
    from hal.config import RobotConfig
    from hal.robot import Robot
    from simulators.rig import Rig
    from simulators.robots.pr2_duster.world import DusterWorld

__all__ = ["Pr2Duster", "forecast", "hardware", "simulator"]


class Pr2Duster:
    """Simulator of the arm. PyBullet is imported when the first world is made."""

    variants = VARIANTS
    conditions = tuple(GRASPS)

    def world(self, variant: str, seed: int, condition: str | None = None) -> DusterWorld:
        """Return the physics of one variant; the seed chooses among actual arms, and their noise.

        Raises:
            ValueError: The variant or condition is not known (UnknownPart).
        """
        from simulators.robots.pr2_duster.world import DusterWorld

        return DusterWorld(make_body(variant, seed), seed, condition)

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """Return the world behind simulated nodes on the robot file's bus."""
        from simulators.rig import Rig

        return Rig(config, self.world(variant, seed, condition), hardware())

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """Return the world without a bus, as fast as it computes."""
        from simulators.direct import direct_robot

        return direct_robot(config, self.world(variant, seed, condition))

    def vision(self, config: RobotConfig, variant: str, seed: int) -> DepthCamera:
        """Return the camera of one variant."""
        return DepthCamera(make_body(variant, seed), seed)


simulator = Pr2Duster()


def forecast(config: RobotConfig, condition: str, command: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return the designer's forecast for commands (n, 7) [rad] under a condition: tool_tip_position [m], (n, 3).

    Raises:
        UnknownPart: The condition is not known.
    """
    check_condition(condition, tuple(GRASPS))
    return {"joint_position": command, SIGNAL: tool_tip(GRASPS[condition], command)}
