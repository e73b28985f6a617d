"""A PR2's arm with a duster in its hand (paper, section III-A): seven joints, and a camera that sees the cloth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from typing_extensions import override

from simulators.faults import check_condition
from simulators.robots.pr2_duster.body import VARIANTS, make_body, tool_tip
from simulators.robots.pr2_duster.camera import SIGNAL, DepthCamera
from simulators.robots.pr2_duster.duster import GRASPS
from simulators.robots.pr2_duster.hardware import hardware
from simulators.robots.simulator import RobotSimulator

if TYPE_CHECKING:
    from hal.config import RobotConfig
    from simulators.robots.pr2_duster.world import DusterWorld

__all__ = ["Pr2Duster", "forecast", "hardware", "simulator"]


class Pr2Duster(RobotSimulator):
    """Simulator of the arm. PyBullet is imported when the first world is made."""

    variants = VARIANTS
    conditions = tuple(GRASPS)

    @override
    def world(self, variant: str, seed: int, condition: str | None = None) -> DusterWorld:
        from simulators.robots.pr2_duster.world import DusterWorld

        return DusterWorld(make_body(variant, seed), seed, condition)

    def vision(self, config: RobotConfig, variant: str, seed: int) -> DepthCamera:
        """Return the camera of one variant."""
        return DepthCamera(make_body(variant, seed), seed)


simulator = Pr2Duster(hardware)


def forecast(config: RobotConfig, condition: str, command: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return the designer's forecast for commands (n, 7) [rad] under a condition: tool_tip_position [m], (n, 3).

    Raises:
        UnknownPart: The condition is not known.
    """
    check_condition(condition, tuple(GRASPS))
    return {"joint_position": command, SIGNAL: tool_tip(GRASPS[condition], command)}
