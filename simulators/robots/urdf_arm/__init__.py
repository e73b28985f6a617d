"""Any arm that a URDF describes: `gemuco init arm.urdf` writes a robot file with this simulator."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from simulators.faults import check_condition
from simulators.physics.choice import using
from simulators.robots.urdf_arm.body import JOINT, VARIANTS, Body, arm_in, make_body

if TYPE_CHECKING:
    from hal.config import RobotConfig
    from hal.robot import Robot
    from simulators.rig import Rig
    from simulators.robots.urdf_arm.camera import TipCamera
    from simulators.robots.urdf_arm.robot_file import Draft
    from simulators.robots.urdf_arm.world import ArmWorld

__all__ = ["UrdfArm", "describe", "random_motion", "simulator"]


class UrdfArm:
    """Simulator of the arm of a robot file. PyBullet is imported when the first world is made."""

    variants = VARIANTS
    conditions: tuple[str, ...] = ()

    def world(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> ArmWorld:
        """Return the physics of one variant; the seed chooses among actual arms, and their noise.

        Raises:
            ConfigError: The variant is not known, or the robot file does not fit the URDF.
        """
        from simulators.robots.urdf_arm.world import ArmWorld

        check_condition(condition, self.conditions)
        with using(config.physics):
            return ArmWorld(config, self._body(config, variant, seed), seed)

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """Return the arm behind simulated nodes on the robot file's buses."""
        from simulators.rig import Rig
        from simulators.robots.bench.equipment import hardware

        return Rig(config, self.world(config, variant, seed, condition), hardware(config))

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """Return the arm without a bus, as fast as it computes."""
        from simulators.direct import direct_robot

        return direct_robot(config, self.world(config, variant, seed, condition))

    def vision(self, config: RobotConfig, variant: str, seed: int) -> TipCamera:
        """Return the camera of one variant."""
        from simulators.robots.urdf_arm.camera import TipCamera

        return TipCamera(arm_in(config).reach, self._body(config, variant, seed), seed)

    def reach(self, config: RobotConfig) -> float:
        """Return the longest distance from the first joint to the tip [m]."""
        return arm_in(config).reach

    def _body(self, config: RobotConfig, variant: str, seed: int) -> Body:
        return make_body(variant, config.signals[JOINT].size, seed)


simulator = UrdfArm()


def random_motion(config: RobotConfig, seed: int) -> Iterator[tuple[np.ndarray, float]]:
    """Yield motor positions [rad], shape (n,), and the time to command each [s], without contact and without end."""
    from simulators.robots.urdf_arm import motion

    return motion.random_motion(config, seed)


def describe(path: Path, tip: str | None, name: str | None, folder: Path) -> Draft:
    """Return the robot file of the arm in a URDF, to be written into a folder, with its EDS files and notes.

    Raises:
        ConfigError: The file is no URDF, or there is no arm in it.
    """
    from simulators.robots.urdf_arm.robot_file import draft

    return draft(path, tip, name, folder)
