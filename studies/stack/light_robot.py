"""A light robot for many at a time: two joints behind springs, six sensors or six CANopen nodes, a small model.

A motor turns, a load bends the spring between motor and joint, and all three are measured, so that each can be
estimated from either of the others. Its robot file has one hub bus, for processes as in life; or no bus, for a device
in the HAL's own process, which is lighter still.
"""

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hal.config import RobotConfig, load_robot
from hal.robot import Robot
from simulators.direct import DirectDevice
from simulators.faults import UnknownPart
from simulators.rig import Rig
from simulators.robots.bench.equipment import hardware
from simulators.world import World

ROOT = Path(__file__).resolve().parents[2]
JOINTS = ("shoulder", "elbow")
MOTOR, JOINT, LOAD = "motor_position", "joint_position", "joint_load"
MASKS = ((MOTOR, LOAD), (JOINT, LOAD), (MOTOR, JOINT))
RANGE = 1.0
"""Joint limits [rad], both ways."""
WEIGHT, STIFFNESS = 30.0, 150.0
"""Load of an outstretched joint [N], and what bends it by 1 rad [N]."""
SPEED = 20.0
"""How fast a motor comes after its set-point [rad/s per rad]."""
NOISE = {MOTOR: 0.002, JOINT: 0.002, LOAD: 0.1}


def body(motor: np.ndarray) -> dict[str, np.ndarray]:
    """Signal -> values [rad, rad, N] at motor positions [rad], all of the shape of `motor`."""
    load = 0.5 * WEIGHT * motor + WEIGHT * np.sin(motor)
    return {JOINT: motor - load / STIFFNESS, MOTOR: motor, LOAD: load}


def states(config: RobotConfig, count: int, seed: int) -> dict[str, np.ndarray]:
    """Random states with noise: signal -> values [its unit], shape (count, 2)."""
    random = np.random.default_rng(seed)
    found = body(random.uniform(-RANGE, RANGE, (count, len(JOINTS))))
    return {name: found[name] + random.normal(0.0, NOISE[name], found[name].shape) for name in config.signals}


class LightWorld:
    """See `simulators.world.World`; a motor that is not driven swings slowly, so that there is something to see."""

    def __init__(self, seed: int) -> None:
        self.time = 0.0
        self._random = np.random.default_rng(seed)
        self._phase = self._random.uniform(0.0, 2.0 * math.pi, len(JOINTS))
        self._motor = np.zeros(len(JOINTS))
        self._targets: dict[int, float] = {}
        self._swings = True

    def step(self, duration: float) -> None:
        """See `World.step`."""
        self.time += duration
        wanted = 0.5 * RANGE * np.sin(0.5 * self.time + self._phase) if self._swings else self._motor.copy()
        for index, target in self._targets.items():
            wanted[index] = target
        self._motor = self._motor + (1.0 - math.exp(-SPEED * duration)) * (wanted - self._motor)

    def measure(self) -> Mapping[str, np.ndarray]:
        """See `World.measure`."""
        return {
            name: value + self._random.normal(0.0, NOISE[name], value.shape) for name, value in self.truth().items()
        }

    def truth(self) -> Mapping[str, np.ndarray]:
        """See `World.truth`."""
        return body(self._motor)

    def drive(self, element: str, target: float, enabled: bool) -> None:
        """See `World.drive`."""
        index = JOINTS.index(element.rpartition(".")[2])
        if enabled:
            self._targets[index], self._swings = target, False
        else:
            self._targets.pop(index, None)

    def break_part(self, part: str) -> None:
        """See `World.break_part`; nothing here can break."""
        raise UnknownPart(f"The light robot has no part '{part}' that can break.")

    def close(self) -> None:
        """See `World.close`."""
        self._targets.clear()


class LiveDevice(DirectDevice):
    """The world in real time: it goes on by itself between two looks."""

    def __init__(self, config: RobotConfig, world: World) -> None:
        super().__init__(config, world, _Wall())
        self._live, self._before = world, time.monotonic()

    def read(self) -> Any:
        """See `Device.read`; the world has gone on meanwhile."""
        now = time.monotonic()
        self._live.step(now - self._before)
        self._before = now
        return super().read()


class _Wall:
    """The wall clock, as far as a direct device asks for it."""

    def monotonic(self) -> float:
        return time.monotonic()


class LightSimulator:
    """What the robot file names as its simulator."""

    variants = ("light",)
    conditions: tuple[str, ...] = ()

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        """See `services.hardware.stand_in.Simulator`."""
        return Rig(config, LightWorld(seed), hardware(config))


simulator = LightSimulator()


def in_process(config: RobotConfig, seed: int) -> Robot:
    """A robot without a bus, in real time."""
    return Robot(config, [LiveDevice(config, LightWorld(seed))], source="simulated")


def description(robot: str, rate: float, with_bus: bool) -> dict[str, Any]:
    """A robot file as a mapping; `rate` [Hz] is the HAL's and the estimation's."""
    stale = max(0.05, 4.0 / rate)
    found: dict[str, Any] = {
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
    return found | (_wiring(robot) if with_bus else {})


def _wiring(robot: str) -> dict[str, Any]:
    """Six nodes on one bus of the hub."""
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
    """A robot file in a folder."""
    file = folder / f"{robot}.yaml"
    file.write_text(yaml.safe_dump(description(robot, rate, with_bus), sort_keys=False))
    return file


def make_model(file: Path, folder: Path) -> None:
    """Train a model that fits a robot file, if there is none; one made for any light robot fits them all."""
    from services.learning import trainer
    from studies.stack import quick_model

    robot = load_robot(file)
    if trainer.fits(robot, folder):
        return
    quick_model.make(robot, states(robot, 2000, 0), MASKS, folder)
