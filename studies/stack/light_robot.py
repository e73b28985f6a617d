"""A light robot, so that one machine runs many: two joints behind springs, six sensors or six CANopen nodes.

A motor turns, a load bends the spring between motor and joint, and all three are measured, so that each can be
estimated from either of the others. Its robot file has one hub bus, for processes as in life; or no bus, for a device
in the HAL's own process, which is lighter still.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hal.config import RobotConfig
from simulators.faults import UnknownPart
from simulators.rig import Rig
from simulators.robots.bench.equipment import hardware

ROOT = Path(__file__).resolve().parents[2]
JOINTS = ("shoulder", "elbow")
MOTOR, JOINT, LOAD = "motor_position", "joint_position", "joint_load"
RANGE = 1.0
"""Joint limits [rad], both ways."""
WEIGHT, STIFFNESS = 30.0, 150.0
"""Load of an outstretched joint [N], and the load that bends its spring by 1 rad [N]."""
SPEED = 20.0
"""Speed of a motor per distance from its set-point [rad/s per rad]."""
SINKING = 0.05
"""Speed at which a released joint sinks to where it hangs, at zero [rad/s]."""
NOISE = {MOTOR: 0.002, JOINT: 0.002, LOAD: 0.1}


def body(motor: np.ndarray) -> dict[str, np.ndarray]:
    """Return signal -> values [rad, rad, N] at motor positions [rad], all of the shape of `motor`."""
    load = 0.5 * WEIGHT * motor + WEIGHT * np.sin(motor)
    return {JOINT: motor - load / STIFFNESS, MOTOR: motor, LOAD: load}


class LightWorld:
    """The robot's body (`simulators.world.World`); it swings until a motor is driven and sinks when released."""

    def __init__(self, seed: int) -> None:
        self.time = 0.0
        self._random = np.random.default_rng(seed)
        self._phase = self._random.uniform(0.0, 2.0 * math.pi, len(JOINTS))
        self._motor = np.zeros(len(JOINTS))
        self._targets: dict[int, float] = {}
        self._swings = True

    def step(self, duration: float) -> None:
        """Advance by a duration [s]."""
        self.time += duration
        wanted = 0.5 * RANGE * np.sin(0.5 * self.time + self._phase) if self._swings else self._motor.copy()
        for index, target in self._targets.items():
            wanted[index] = target
        self._motor = self._motor + (1.0 - math.exp(-SPEED * duration)) * (wanted - self._motor)
        if not self._swings:
            released = [index for index in range(len(JOINTS)) if index not in self._targets]
            self._motor[released] -= np.clip(self._motor[released], -SINKING * duration, SINKING * duration)

    def measure(self) -> Mapping[str, np.ndarray]:
        """Return all signals with noise."""
        return {
            name: value + self._random.normal(0.0, NOISE[name], value.shape) for name, value in self.truth().items()
        }

    def truth(self) -> Mapping[str, np.ndarray]:
        """Return all signals without noise."""
        return body(self._motor)

    def drive(self, element: str, target: float, enabled: bool) -> None:
        """Set the target [rad] of one motor, or release it."""
        index = JOINTS.index(element.rpartition(".")[2])
        if enabled:
            self._targets[index], self._swings = target, False
        else:
            self._targets.pop(index, None)

    def break_part(self, part: str) -> None:
        """Refuse: this body has no part that can break."""
        raise UnknownPart(f"The light robot has no part '{part}' that can break.")

    def close(self) -> None:
        """Release all motors."""
        self._targets.clear()


class LightSimulator:
    """The simulator that the robot file names; see `services.hardware.stand_in.Simulator`."""

    variants = ("light",)
    conditions: tuple[str, ...] = ()

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """Return the simulated hardware behind the robot file's buses."""
        return Rig(config, LightWorld(seed), hardware(config))

    def world(self, variant: str, seed: int, condition: str | None = None) -> LightWorld:
        """Return the body alone."""
        return LightWorld(seed)


simulator = LightSimulator()


def description(robot: str, rate: float, with_bus: bool) -> dict[str, Any]:
    """Return a robot file as a mapping; `rate` [Hz] is that of HAL and estimation."""
    stale = max(0.05, 4.0 / rate)
    content: dict[str, Any] = {
        "robot": robot,
        "description": "Two joints behind springs, for measurements of many robots.",
        "signals": {
            JOINT: {"unit": "rad", "elements": list(JOINTS), "stale_after": stale},
            MOTOR: {"unit": "rad", "elements": list(JOINTS), "stale_after": stale},
            LOAD: {"unit": "N", "elements": list(JOINTS), "stale_after": stale},
        },
        "command": {"signal": MOTOR, "time_to_live": 0.3, "hold": 1.0},
        "limits": {MOTOR: {"low": -RANGE, "high": RANGE, "rate": 1.0}, JOINT: {"low": -RANGE, "high": RANGE}},
        "rates": {
            "hal": rate, "estimation": rate, "control": min(rate, 20.0), "anomaly": min(rate, 10.0), "update": 1.0
        },
        "simulator": "studies.stack.light_robot:simulator",
        "model": {"control": {"target": JOINT}},
    }  # fmt: skip
    return content | (_wiring(robot) if with_bus else {})


def _wiring(robot: str) -> dict[str, Any]:
    """Return the wiring of six nodes on one bus of the hub."""
    eds, devices = ROOT / "robots" / "eds", {}
    for number, joint in enumerate(JOINTS, 1):
        for kind, offset, signal in (("drive", 0, MOTOR), ("cell", 10, LOAD), ("encoder", 20, JOINT)):
            devices[f"{joint}_{kind}"] = {
                "kind": kind, "bus": "can0", "node": offset + number, "element": f"{signal}.{joint}"
            }  # fmt: skip
    return {
        "buses": {"can0": {"interface": "hub", "channel": f"{robot}_can0"}},
        "kinds": {
            "drive": {
                "driver": "cia402",
                "settings": {"eds": str(eds / "servo_drive.eds"), "counts_per_turn": 4096, "gear": 29,
                             "rated_torque": 0.1},
            },
            "cell": {"driver": "cia404", "settings": {"eds": str(eds / "load_cell.eds")}},
            "encoder": {
                "driver": "cia406",
                "settings": {"eds": str(eds / "joint_encoder.eds"), "counts_per_turn": 262144, "zero": -math.pi},
            },
        },
        "devices": devices,
    }  # fmt: skip


def write(folder: Path, robot: str, rate: float, with_bus: bool) -> Path:
    """Write a robot file into a folder and return its path."""
    file = folder / f"{robot}.yaml"
    file.write_text(yaml.safe_dump(description(robot, rate, with_bus), sort_keys=False))
    return file
