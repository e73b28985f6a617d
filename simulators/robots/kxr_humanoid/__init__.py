"""A KXR-like humanoid of little stiffness that holds a tool (paper, III-C): four joints, eight load cells, a camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from simulators.faults import check_condition
from simulators.robots.kxr_humanoid.body import TOOLS, VARIANTS, make_body, nominal
from simulators.robots.kxr_humanoid.eye import PIXEL, POSITION, Eye
from simulators.robots.kxr_humanoid.hardware import hardware
from simulators.robots.kxr_humanoid.statics import rest
from simulators.robots.kxr_humanoid.world import CENTER, COMMAND, HumanoidWorld

if TYPE_CHECKING:
    from hal.config import RobotConfig
    from hal.robot import Robot
    from simulators.rig import Rig

__all__ = ["KxrHumanoid", "forecast", "hardware", "simulator"]


class KxrHumanoid:
    """Simulator of the robot."""

    variants = VARIANTS
    conditions = tuple(TOOLS)

    def world(self, variant: str, seed: int, condition: str | None = None) -> HumanoidWorld:
        """Return the physics of one variant; the seed chooses among actual robots, and their noise.

        Raises:
            ValueError: The variant or condition is not known.
        """
        return HumanoidWorld(make_body(variant, seed), seed, condition)

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """Return the world behind simulated nodes on the robot file's bus."""
        from simulators.rig import Rig

        return Rig(config, self.world(variant, seed, condition), hardware())

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """Return the world without a bus, as fast as it computes."""
        from simulators.direct import direct_robot

        return direct_robot(config, self.world(variant, seed, condition))

    def vision(self, config: RobotConfig, variant: str, seed: int) -> Eye:
        """Return the camera of one variant."""
        return Eye(make_body(variant, seed), np.random.default_rng([seed, 13]))

    def geometric(self, condition: str | None, command: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return the forecast of a stiff body, the model of a full-body inverse kinematics."""
        return _told(condition, command, stiff=True)


simulator = KxrHumanoid()


def forecast(config: RobotConfig, condition: str | None, command: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return the designer's forecast, deflection included, for commands [rad], shape (n, 4), under a condition.

    Returns:
        center_of_gravity and tool_tip_position [m], shapes (n, 2), (n, 3), and tool_tip_pixel [px], shape (n, 2), which
        may be beyond the image and is NaN behind the camera.

    Raises:
        UnknownPart: The condition is not known.
    """
    return _told(condition, command, stiff=False)


def _told(condition: str | None, command: np.ndarray, stiff: bool) -> Mapping[str, np.ndarray]:
    tool = TOOLS[str(check_condition(condition, tuple(TOOLS)))]
    state = rest(nominal(), tool, np.asarray(command, float), stiff)
    return {COMMAND: command, CENTER: state.center, POSITION: state.tip, PIXEL: state.pixel}
