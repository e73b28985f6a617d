"""The simulator that a robot file names, and the interface that services use."""

import logging
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.robot import Robot
from services.wire.messages import MessageError

log = logging.getLogger(__name__)


class Camera(Protocol):
    """The camera of a simulated robot."""

    def see(self, truth: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Return the vision signals [their units], shapes (n,), for true values of all signals; NaN if not visible."""
        ...

    def fault(self, text: str) -> str:
        """Apply or end a fault, and return a sentence about it. A ValueError lists the known faults."""
        ...


class Simulator(Protocol):
    """Simulator of a robot. A condition of None is the first of `conditions`."""

    variants: tuple[str, ...]
    """The first variant is the designer's model."""
    conditions: tuple[str, ...]
    """The body can have these conditions; empty if it has only one."""

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Any:
        """Return the simulated hardware behind the robot file's buses (`simulators.rig.Rig`), not started yet."""
        ...

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        """Return the simulated robot without a bus, not open yet."""
        ...

    def vision(self, config: RobotConfig, variant: str, seed: int) -> Camera:
        """Return the camera of a robot that has signals of source `vision`."""
        ...


def simulator_of(robot: RobotConfig) -> Simulator:
    """Load the simulator that the robot file names.

    Raises:
        ConfigError: The file names no existing simulator, or the simulator lacks one of the file's conditions.
    """
    if robot.simulator is None:
        raise ConfigError(
            f"Robot '{robot.robot}' names no simulator; add `simulator: module:name` to its file. "
            "simulators.robots.bench:simulator stands in for the devices of any robot file."
        )
    simulator: Simulator = registry.load_object(robot.simulator, "simulator", ("variants", "conditions", "rig"))
    unknown = [condition for condition in robot.conditions if condition not in simulator.conditions]
    if unknown:
        known = ", ".join(simulator.conditions) or "none"
        raise ConfigError(
            f"The simulator of '{robot.robot}' has no condition '{unknown[0]}'. Known conditions: {known}."
        )
    return simulator


def variant_of(robot: RobotConfig, variant: str | None) -> str:
    """Return the given variant, or the designer's.

    Raises:
        ConfigError: The simulator has no such variant.
    """
    variants = simulator_of(robot).variants
    if variant is not None and variant not in variants:
        known = ", ".join(variants)
        raise ConfigError(f"The simulator of '{robot.robot}' has no variant '{variant}'. Known variants: {known}.")
    return variants[0] if variant is None else variant


def condition_of(robot: RobotConfig, condition: str | None) -> str | None:
    """Return the given condition, or the robot file's first; None if the file has none.

    Raises:
        ConfigError: Neither the robot file nor its simulator knows it.
    """
    if condition is None:
        return robot.conditions[0] if robot.conditions else None
    known = dict.fromkeys((*robot.conditions, *simulator_of(robot).conditions))
    if condition not in known:
        names = ", ".join(known) or "none"
        raise ConfigError(f"Robot '{robot.robot}' has no condition '{condition}'. Known conditions: {names}.")
    return condition


def fault_verb(apply: Callable[[str], str], example: str) -> Callable[[dict[str, Any]], dict[str, str]]:
    """Return the handler of the verb `fault`, which applies a fault and replies with a sentence about it."""

    def handle(arguments: dict[str, Any]) -> dict[str, str]:
        text = arguments.get("text")
        if not isinstance(text, str) or not text.strip():
            raise MessageError(f"The verb 'fault' takes {{text: what to break}}, as in '{example}'.")
        sentence = apply(text.strip())
        log.info("%s", sentence)
        return {"text": sentence}

    return handle
