"""A small robot for the tests of the processes: one joint, two muscles, their CANopen nodes, and a world of wires.

Its robot file names this module as the simulator, so that both ends run as processes of their own.
"""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import yaml

from hal.config import RobotConfig
from services.client import Client
from services.process.supervisor import die_with
from services.wire import keys
from services.wire.messages import Status
from simulators.nodes.canopen.spec import CellConstants, DriveConstants, EncoderConstants, NodeSpec
from simulators.rig import Rig

ROOT = Path(__file__).resolve().parents[2]
EDS = ROOT / "robots" / "eds"
MUSCLES = ("biceps", "triceps")
TIME_TO_LIVE = 0.2
HOLD = 0.5
FRESH = 0.1


def description(robot: str) -> dict[str, Any]:
    """A robot file as a mapping."""
    wire = {"counts_per_turn": 4096, "gear": 29, "spool_radius": 0.008, "rated_torque": 0.1}
    devices: dict[str, Any] = {"elbow_encoder": {"kind": "encoder", "bus": "can1", "node": 21,
                                                 "element": "joint_position.elbow"}}  # fmt: skip
    for number, (bus, muscle) in enumerate(zip(("can0", "can1"), MUSCLES, strict=True), 1):
        devices[f"{muscle}_drive"] = {"kind": "drive", "bus": bus, "node": number, "element": f"muscle_length.{muscle}"}
        devices[f"{muscle}_cell"] = {
            "kind": "cell", "bus": bus, "node": 10 + number, "element": f"muscle_tension.{muscle}",
        }  # fmt: skip
    return {
        "robot": robot,
        "signals": {
            "joint_position": {"unit": "rad", "elements": ["elbow"]},
            "muscle_tension": {"unit": "N", "elements": list(MUSCLES)},
            "muscle_length": {"unit": "m", "elements": list(MUSCLES)},
        },
        "command": {"signal": "muscle_length", "time_to_live": TIME_TO_LIVE, "hold": HOLD},
        "limits": {"muscle_tension": {"soft_high": 200, "trip_high": 400}, "muscle_length": {"rate": 0.25}},
        "buses": {bus: {"interface": "hub", "channel": f"{robot}_{bus}"} for bus in ("can0", "can1")},
        "kinds": {
            "drive": {"driver": "cia402", "settings": {"eds": str(EDS / "servo_drive.eds"), **wire}},
            "cell": {"driver": "cia404", "settings": {"eds": str(EDS / "load_cell.eds")}},
            "encoder": {"driver": "cia406", "settings": {"eds": str(EDS / "joint_encoder.eds"), "zero": -math.pi}},
        },
        "devices": devices,
        "simulator": "small_arm:simulator",
    }


def _hardware() -> list[NodeSpec]:
    nodes = [NodeSpec("elbow_encoder", "can1", 21, "joint_position.elbow", EncoderConstants())]
    for number, (bus, muscle) in enumerate(zip(("can0", "can1"), MUSCLES, strict=True), 1):
        load = f"muscle_tension.{muscle}"
        nodes.append(NodeSpec(f"{muscle}_drive", bus, number, f"muscle_length.{muscle}", DriveConstants(load=load)))
        nodes.append(NodeSpec(f"{muscle}_cell", bus, 10 + number, load, CellConstants()))
    return nodes


class WireWorld:
    """Two wires whose lengths follow their servos at 0.5 m/s at most, under constant tension."""

    def __init__(self) -> None:
        self.time = 0.0
        self._length = np.zeros(2)
        self._flicker = False
        """The last bit of real sensors is noise, so that they do not look frozen while the robot moves."""
        self._targets: dict[str, float] = {}

    def step(self, duration: float) -> None:
        self.time += duration
        self._flicker = not self._flicker
        way = 0.5 * duration
        for index, muscle in enumerate(MUSCLES):
            target = self._targets.get(f"muscle_length.{muscle}")
            if target is not None:
                self._length[index] += np.clip(target - self._length[index], -way, way)

    def truth(self) -> Mapping[str, np.ndarray]:
        return {
            "joint_position": np.array([0.3]),
            "muscle_tension": np.array([20.0, 30.0]),
            "muscle_length": self._length.copy(),
        }

    def measure(self) -> Mapping[str, np.ndarray]:
        true = self.truth()
        noise = {"joint_position": 3e-5 * self._flicker, "muscle_tension": 0.01 * self._flicker}
        return {name: value + noise.get(name, 0.0) for name, value in true.items()}

    def drive(self, element: str, target: float, enabled: bool) -> None:
        if enabled:
            self._targets[element] = target
        else:
            self._targets.pop(element, None)

    def break_part(self, part: str) -> None:
        raise ValueError(f"The small arm has no part '{part}'.")

    def close(self) -> None:
        self._targets.clear()


class SmallArm:
    variants = ("plain",)

    conditions: tuple[str, ...] = ()

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        return Rig(config, WireWorld(), _hardware())


simulator = SmallArm()

_RUN = {
    "simulator": "from services.hardware.simulator_service import run_simulator as run; arguments = ('plain', 0)",
    "hal": "from services.hardware.hal_service import run_hal as run; arguments = ()",
}
_MAIN = """
import sys
from hal.config import load_robot
{load}
try:
    sys.exit(run(load_robot(sys.argv[1]), *arguments))
except Exception as error:
    sys.exit(str(error))
"""


def eventually(happened: Callable[[], bool], within: float = 15.0) -> float:
    """How long [s] it took to happen."""
    start = time.monotonic()
    while not happened():
        assert time.monotonic() - start < within, "it did not happen"
        time.sleep(0.005)
    return time.monotonic() - start


class Processes:
    """The simulator and the HAL of a small arm as processes, and a client."""

    def __init__(self, robot: str, folder: Path) -> None:
        self.robot = robot
        self.file = folder / f"{robot}.yaml"
        self.file.write_text(yaml.safe_dump(description(robot)))
        self.client = Client(robot)
        self._running: dict[str, subprocess.Popen[str]] = {}

    def __enter__(self) -> Self:
        self.client.__enter__()
        try:
            self.start("simulator")
            self.start("hal")
            eventually(lambda: self.all_valid())
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for service in list(self._running):
            self.kill(service)
        self.client.__exit__(None, None, None)

    def popen(self, service: str) -> subprocess.Popen[str]:
        """Start one process, without keeping it."""
        path = f"{Path(__file__).parent}{os.pathsep}{ROOT}"
        return subprocess.Popen(
            [sys.executable, "-c", _MAIN.format(load=_RUN[service]), str(self.file)],
            env={**os.environ, "PYTHONPATH": path},
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=die_with(os.getpid()),
        )

    def start(self, service: str) -> None:
        self._running[service] = self.popen(service)

    def pid(self, service: str) -> int:
        return self._running[service].pid

    def kill(self, service: str) -> None:
        """As kill -9."""
        process = self._running.pop(service)
        process.kill()
        process.communicate()
        time.sleep(FRESH)  # what it sent last is not to be taken for its successor's

    def terminate(self, service: str) -> tuple[int, str]:
        """As SIGTERM; exit code and what was written to stderr."""
        self._running[service].terminate()
        return self.ended(service)

    def ended(self, service: str) -> tuple[int, str]:
        """Wait for one that was told to end; exit code and what was written to stderr."""
        process = self._running.pop(service)
        said = process.communicate(timeout=20.0)[1]
        time.sleep(FRESH)
        return process.returncode, said

    def all_valid(self) -> bool:
        """Whether a fresh sample has all its values."""
        sample = self.client.sample(max_age=FRESH)
        return sample is not None and all(valid.all() for valid in sample.valid.values())

    def mode(self) -> str:
        """The mode of the newest applied set-points; empty without fresh ones."""
        applied = self.client.applied(max_age=FRESH)
        return "" if applied is None else applied.mode

    def refused(self) -> dict[str, Any]:
        """The HAL's counters of commands, from a status that is newer than this call."""
        reader = self.client.reader(keys.status(self.robot, "hal"), Status)
        status = reader.wait(10.0)
        assert status is not None
        return dict(status.facts["commands"])
