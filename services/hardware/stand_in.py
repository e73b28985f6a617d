"""What a robot file names as its simulator, as far as services go into it."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.robot import Robot


class Camera(Protocol):
    """The camera of a simulated robot."""

    def see(self, truth: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """The vision signals [their units], shapes (n,), when every signal is so; NaN where it sees nothing."""
        ...

    def fault(self, text: str) -> str:
        """Break or mend something; the sentence tells what was done. A ValueError lists what can break."""
        ...


class Simulator(Protocol):
    """What stands in for a robot. A condition of None is the first of `conditions`."""

    variants: tuple[str, ...]
    """The designer's model first."""
    conditions: tuple[str, ...]
    """Ways the body can be; empty if there is only one."""

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Any:
        """The simulated hardware behind the robot file's buses (`simulators.rig.Rig`); not started yet."""
        ...

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """The simulated robot without a bus; not opened yet."""
        ...

    def vision(self, config: RobotConfig, variant: str, seed: int) -> Camera:
        """The robot's camera; only of a robot that has signals of source `vision`."""
        ...


def simulator_of(robot: RobotConfig) -> Simulator:
    """What the robot file names as its simulator.

    Raises:
        ConfigError: It names none, or one that is not there, or one that does not know the file's conditions.
    """
    if robot.simulator is None:
        raise ConfigError(
            f"Robot '{robot.robot}' names no simulator; add `simulator: module:name` to its file. "
            "simulators.robots.bench:simulator stands in for the devices of any robot file."
        )
    simulator: Simulator = registry.load_object(robot.simulator)
    strange = [condition for condition in robot.conditions if condition not in simulator.conditions]
    if strange:
        known = ", ".join(simulator.conditions) or "none"
        raise ConfigError(
            f"The simulator of '{robot.robot}' has no condition '{strange[0]}'. Known conditions: {known}."
        )
    return simulator


def variant_of(robot: RobotConfig, variant: str | None) -> str:
    """The variant that was asked for, or the designer's.

    Raises:
        ConfigError: The simulator has no such variant.
    """
    variants = simulator_of(robot).variants
    if variant is not None and variant not in variants:
        known = ", ".join(variants)
        raise ConfigError(f"The simulator of '{robot.robot}' has no variant '{variant}'. Known variants: {known}.")
    return variants[0] if variant is None else variant


def condition_of(robot: RobotConfig, condition: str | None) -> str | None:
    """The condition that was asked for, or the robot file's first; None if the file has none.

    Raises:
        ConfigError: Neither the robot file nor its simulator knows it.
    """
    if condition is None:
        return robot.conditions[0] if robot.conditions else None
    known = dict.fromkeys((*robot.conditions, *simulator_of(robot).conditions))
    if condition not in known:
        told = ", ".join(known) or "none"
        raise ConfigError(f"Robot '{robot.robot}' has no condition '{condition}'. Known conditions: {told}.")
    return condition
