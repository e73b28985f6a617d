"""A robot file on the bench, on virtual buses, driven by the real drivers."""

import itertools
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from hal.config import RobotConfig
from hal.errors import CommandRefused
from hal.robot import Robot, open_robot
from hal.sample import Sample
from simulators.rig import Rig
from simulators.robots.bench import simulator

PATIENCE = 60.0
"""A condition is awaited for this time [s], on a machine that may be busy."""
_numbers = itertools.count()


def virtual(body: dict[str, Any]) -> RobotConfig:
    """Return the robot of a robot file, on virtual buses and pseudo-terminals that no other test has."""
    number = next(_numbers)
    for name, bus in body["buses"].items():
        kind = "pty" if bus.get("interface") == "serial" else "virtual"
        bus.update(interface=kind, channel=f"on_bench_{os.getpid()}_{number}_{name}")
    return RobotConfig.model_validate(body)


@contextmanager
def running(config: RobotConfig) -> Iterator[tuple[Robot, Rig]]:
    rig = simulator.rig(config, "bench", 0)
    rig.start()
    try:
        with open_robot(config) as robot:
            yield robot, rig
    finally:
        rig.stop()
    assert not rig.failure


def states(robot: Robot) -> dict[str, str]:
    return {name: str(device["state"]) for name, device in robot.health()["devices"].items()}


def cycle_until(robot: Robot, condition: Any, target: np.ndarray | None = None) -> Sample:
    """Run cycles, enabled and towards `target` if there is one, until a condition of the sample holds."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        sample, _ = robot.cycle()
        is_valid = sample.complete and all(valid.all() for valid in sample.valid.values())
        if target is not None and robot.mode == "off" and is_valid:
            with suppress(CommandRefused):  # a drive that is still opening is enabled a few cycles later
                robot.enable()
        elif target is not None and robot.mode in ("hold", "follow"):
            robot.command(target, sample.cycle)
        if condition(sample):
            return sample
        robot.clock.sleep_until(robot.clock.monotonic() + robot.period)
    raise AssertionError(f"not within {PATIENCE:g} s: {sample.values} {robot.mode} {robot.health()['devices']}")


def arrives(signal: str, target: np.ndarray, tolerance: float = 0.01) -> Any:
    return lambda sample: bool(np.all(np.abs(sample.values[signal] - target) < tolerance))
