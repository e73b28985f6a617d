"""Base of the simulators of single robots (`services.hardware.stand_in.Simulator`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

from simulators.physics.choice import using

if TYPE_CHECKING:
    from hal.config import RobotConfig
    from hal.robot import Robot
    from simulators.nodes.canopen.spec import NodeSpec
    from simulators.rig import Rig
    from simulators.world import World


class RobotSimulator(ABC):
    """Simulator of one robot. The HAL and the simulated nodes are imported when they are first used.

    Args:
        hardware: Returns the simulated nodes of the robot.
    """

    def __init__(self, hardware: Callable[[], list[NodeSpec]]) -> None:
        self._hardware = hardware

    @abstractmethod
    def world(self, variant: str, seed: int, condition: str | None = None) -> World:
        """Return the physics of one variant; the seed chooses among actual robots, and their noise.

        Raises:
            ValueError: The variant or condition is not known (UnknownPart).
        """

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """Return the world behind simulated nodes on the robot file's buses."""
        from simulators.rig import Rig

        with using(config.physics):
            return Rig(config, self.world(variant, seed, condition), self._hardware())

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """Return the world without a bus, as fast as it computes."""
        from simulators.direct import direct_robot

        with using(config.physics):
            return direct_robot(config, self.world(variant, seed, condition))
