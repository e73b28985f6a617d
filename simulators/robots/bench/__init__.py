"""Any robot file on a bench: its devices with nothing behind them, to try wiring, drivers and limits without hardware.

    simulator: simulators.robots.bench:simulator

The nodes follow the robot file, so a wrong gear or zero in it has no effect here; a simulator that knows
the hardware by itself, as those of the other robots do, finds it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from simulators.faults import check_condition
from simulators.robots.bench.equipment import hardware
from simulators.robots.bench.world import BenchWorld

if TYPE_CHECKING:
    from hal.config import RobotConfig
    from hal.robot import Robot
    from simulators.rig import Rig

__all__ = ["Bench", "hardware", "simulator"]


class Bench:
    """Stand-in for hardware of which only the robot file is known."""

    variants = ("bench",)
    conditions: tuple[str, ...] = ()

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """Return the bench behind simulated nodes on the robot file's buses; it has no noise, so no seed.

        Raises:
            ConfigError: A device of the robot file has no simulated counterpart.
        """
        from simulators.rig import Rig

        check_condition(condition, self.conditions)
        return Rig(config, BenchWorld(config), hardware(config))

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """Return the bench without a bus, as fast as it computes."""
        from simulators.direct import direct_robot

        check_condition(condition, self.conditions)
        return direct_robot(config, BenchWorld(config))


simulator = Bench()
