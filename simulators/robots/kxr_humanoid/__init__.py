"""A KXR-like humanoid of little stiffness that holds a tool (paper, III-C): four joints, eight load cells, a camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from typing_extensions import override

from simulators.faults import check_condition
from simulators.robots.kxr_humanoid.body import TOOLS, VARIANTS, make_body, nominal
from simulators.robots.kxr_humanoid.eye import PIXEL, POSITION, Eye
from simulators.robots.kxr_humanoid.hardware import hardware
from simulators.robots.kxr_humanoid.statics import rest
from simulators.robots.kxr_humanoid.world import CENTER, COMMAND, HumanoidWorld
from simulators.robots.simulator import RobotSimulator

if TYPE_CHECKING:
    from hal.config import RobotConfig

__all__ = ["KxrHumanoid", "forecast", "hardware", "simulator"]


class KxrHumanoid(RobotSimulator):
    """Simulator of the robot."""

    variants = VARIANTS
    conditions = tuple(TOOLS)

    @override
    def world(self, variant: str, seed: int, condition: str | None = None) -> HumanoidWorld:
        return HumanoidWorld(make_body(variant, seed), seed, condition)

    def vision(self, config: RobotConfig, variant: str, seed: int) -> Eye:
        """Return the camera of one variant."""
        return Eye(make_body(variant, seed), np.random.default_rng([seed, 13]))

    def geometric(self, condition: str | None, command: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return the forecast of a stiff body, the model of a full-body inverse kinematics."""
        return _posture(condition, command, stiff=True)


simulator = KxrHumanoid(hardware)


def forecast(config: RobotConfig, condition: str | None, command: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return the designer's forecast, deflection included, for commands [rad], shape (n, 4), under a condition.

    Returns:
        center_of_gravity and tool_tip_position [m], shapes (n, 2), (n, 3), and tool_tip_pixel [px], shape (n, 2), which
        may be beyond the image and is NaN behind the camera.

    Raises:
        UnknownPart: The condition is not known.
    """
    return _posture(condition, command, stiff=False)


def _posture(condition: str | None, command: np.ndarray, stiff: bool) -> Mapping[str, np.ndarray]:
    tool = TOOLS[str(check_condition(condition, tuple(TOOLS)))]
    state = rest(nominal(), tool, np.asarray(command, float), stiff)
    return {COMMAND: command, CENTER: state.center, POSITION: state.tip, PIXEL: state.pixel}
