"""Any robot file on a bench: its devices with nothing or a made-up body behind them, to try it without hardware.

    simulator: simulators.robots.bench:simulator  # every sensor keeps the value that it was set to
    simulator: simulators.robots.bench:body       # every sensor follows the drives, by made-up functions

The nodes follow the robot file, so a wrong gear or zero in it has no effect here; a simulator that knows
the hardware by itself, as those of the other robots do, finds it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from simulators.faults import check_condition
from simulators.robots.bench.equipment import hardware

if TYPE_CHECKING:
    from hal.config import RobotConfig
    from hal.robot import Robot
    from simulators.rig import Rig
    from simulators.robots.bench.world import BenchWorld

__all__ = ["Bench", "body", "hardware", "simulator"]

ACTUAL = "actual"


class Bench:
    """Stand-in for hardware of which only the robot file is known."""

    variants: tuple[str, ...]
    conditions: tuple[str, ...] = ()

    def __init__(self, has_body: bool = False) -> None:
        """Make a bench.

        Args:
            has_body: Whether the sensors follow the drives, with noise; otherwise they keep what they were set to.
        """
        self._has_body = has_body
        self.variants = ("bench", ACTUAL) if has_body else ("bench",)

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """Return the bench behind simulated nodes on the robot file's buses; only a body has noise, from the seed.

        Raises:
            ConfigError: A device of the robot file has no simulated counterpart.
        """
        from simulators.rig import Rig

        check_condition(condition, self.conditions)
        return Rig(config, self._world(config, variant, seed), hardware(config))

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """Return the bench without a bus, as fast as it computes."""
        from simulators.direct import direct_robot

        check_condition(condition, self.conditions)
        return direct_robot(config, self._world(config, variant, seed))

    def _world(self, config: RobotConfig, variant: str, seed: int) -> BenchWorld:
        if self._has_body:
            from simulators.robots.bench.made_up import BenchBody

            return BenchBody(config, hardware(config), seed, variant == ACTUAL)
        from simulators.robots.bench.world import BenchWorld

        return BenchWorld(config)


simulator = Bench()
body = Bench(has_body=True)
