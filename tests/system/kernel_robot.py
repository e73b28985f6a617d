"""A robot on CAN interfaces of a real kernel: its file, its nodes in a process of their own, and a master at 20 Hz.

`python tests/system/kernel_robot.py FILE [FAULT...]` is the nodes.
"""

import contextlib
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np
import pytest
import yaml

from hal.config import RobotConfig, load_robot
from hal.errors import CommandRefused
from hal.robot import open_robot

ROOT = Path(__file__).parents[2]
EDS = ROOT / "robots" / "eds"
DBC = ROOT / "robots" / "dbc"
RATE = 20.0
"""Cycles per second [Hz]; a kernel in user mode on a shared machine stands still for 0.1 s now and then."""
NEEDS_CAN_UTILS = pytest.mark.skipif(
    not all(map(shutil.which, ("cangen", "candump"))), reason="no cangen and candump (package can-utils)"
)
PATIENCE = 120.0
"""How long [s] anything may take; no test depends on being faster."""


def description(near: str = "vcan0", far: str = "vcan1") -> dict:
    """Two muscles and a joint on two interfaces, with a device of every kind that has a protocol of its own."""
    patient = {"silent_after": 0.5}
    cell = {"force": {"signal": "Force.Force"}}
    quick = {"stiffness": 300_000, "damping": 10_000, "watch_time": 2.0}  # N/m, N s/m: 19 N m/rad and 0.6 N m s/rad
    drive = {"counts_per_turn": 4096, "gear": 29, "spool_radius": 0.008, "rated_torque": 0.1, "watch_time": 2.0}
    return {
        "robot": "kernel",
        "signals": {
            "muscle_length": {"unit": "m", "elements": ["biceps", "triceps"], "stale_after": 0.25},
            "muscle_tension": {"unit": "N", "elements": ["biceps", "triceps", "deltoid"], "stale_after": 0.25},
            "joint_position": {
                "unit": "rad",
                "elements": ["elbow"],
                "stale_after": 0.25,
                "plausible": {"frozen_after": float("inf")},  # no muscle of the bench moves it, and it has no noise
            },
        },
        "command": {"signal": "muscle_length", "time_to_live": 1.0, "hold": 5.0},
        "limits": {"muscle_length": {"low": 0.25, "high": 0.35, "rate": 0.25}},
        "rates": {"hal": RATE},
        "buses": {
            "can0": {"interface": "socketcan", "channel": near},
            "can1": {"interface": "socketcan", "channel": far},
        },
        "kinds": {
            "drive": {"driver": "cia402", "settings": {**patient, **drive, "eds": str(EDS / "servo_drive.eds")}},
            "cell": {"driver": "cia404", "settings": {**patient, "eds": str(EDS / "load_cell.eds")}},
            "input": {
                "driver": "cia401",
                "settings": {**patient, "eds": str(EDS / "analog_input.eds"), "gain": 0.02},
            },
            "quick": {
                "driver": "mit",
                "settings": {**patient, "motor": "DM4340", "spool_radius": 0.008, "zero": 0.3, **quick},
            },
            "messages": {
                "driver": "dbc",
                "settings": {
                    **patient,
                    "dbc": str(DBC / "load_cell.dbc"),
                    "node_offset": 1,
                    "periods": {"Force": 1.0 / RATE},
                    "quantities": cell,
                    "error": {"signal": "Force.Status", "good": "GOOD"},
                },
            },
            "encoder": {"driver": "cia406", "settings": {**patient, "eds": str(EDS / "joint_encoder.eds")}},
        },
        "devices": {
            "biceps_drive": {"kind": "drive", "bus": "can0", "node": 1, "element": "muscle_length.biceps"},
            "biceps_cell": {"kind": "cell", "bus": "can0", "node": 11, "element": "muscle_tension.biceps"},
            "triceps_cell": {"kind": "input", "bus": "can1", "node": 12, "element": "muscle_tension.triceps"},
            "triceps_drive": {"kind": "quick", "bus": "can1", "node": 5, "element": "muscle_length.triceps"},
            "deltoid_cell": {"kind": "messages", "bus": "can1", "node": 3, "element": "muscle_tension.deltoid"},
            "elbow_encoder": {"kind": "encoder", "bus": "can1", "node": 21, "element": "joint_position.elbow"},
        },
    }


def one_muscle(channel: str) -> dict:
    """The biceps alone, on one interface."""
    raw = description(channel)
    del raw["buses"]["can1"], raw["signals"]["joint_position"]
    for name in ("muscle_length", "muscle_tension"):
        raw["signals"][name]["elements"] = ["biceps"]
    raw["devices"] = {name: device for name, device in raw["devices"].items() if device["bus"] == "can0"}
    return raw


def write(folder: Path, raw: dict) -> Path:
    """The robot file."""
    path = folder / "kernel.yaml"
    path.write_text(yaml.safe_dump(raw))
    return path


class Nodes:
    """The other end of the wire, in a process of its own."""

    def __init__(self, robot_file: Path, *faults: str) -> None:
        command = [sys.executable, str(Path(__file__)), str(robot_file), *faults]
        self._process = subprocess.Popen(command, cwd=ROOT, env=None)

    def freeze(self) -> None:
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self.thaw()
        self._process.terminate()
        self._process.wait(20)


class Master:
    """The HAL, cycled in a thread of its own at `RATE`; every sample is looked at."""

    def __init__(self, config: RobotConfig) -> None:
        self.robot = open_robot(config)
        self.sample = None
        self.stale_but_valid: list[str] = []
        self.target: np.ndarray | None = None
        self._limits = {name: signal.stale_after for name, signal in config.signals.items()}
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.failure: BaseException | None = None

    def __enter__(self) -> "Master":
        self.robot.open()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()
        self.robot.close()

    def _run(self) -> None:
        due = time.monotonic()
        try:
            while not self._ending.is_set():
                sample, _ = self.robot.cycle()
                self._check(sample)
                self.sample = sample
                if self.target is not None and self.robot.mode in ("hold", "follow"):
                    self.robot.command(self.target, sample.cycle)
                due = max(due + 1.0 / RATE, time.monotonic())
                self._ending.wait(due - time.monotonic())
        except BaseException as error:
            self.failure = error

    def _check(self, sample) -> None:
        for name, valid in sample.valid.items():
            bad = valid & ~np.isfinite(sample.values[name])
            if bad.any():
                self.stale_but_valid.append(f"cycle {sample.cycle}: {name} is NaN and valid")

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for something, as long as the machine needs."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert self.failure is None, repr(self.failure)
            assert time.monotonic() < deadline, f"{what}: {self.robot.health()}"
            time.sleep(0.02)

    def until_whole(self, what: str) -> None:
        self.until(lambda: self.sample is not None and all(v.all() for v in self.sample.valid.values()), what)

    def enable(self) -> None:
        """Enable, and again if this machine stood still for longer than a cycle may take: that is a fault, rightly."""

        def is_enabled() -> bool:
            if self.robot.mode == "fault" and "The cycle did not turn" in self.robot.fault_text:
                with contextlib.suppress(CommandRefused):  # a drive has power still, or is not ready yet
                    self.robot.reset()
                    self.robot.enable()
            return self.robot.mode == "hold"

        self.robot.enable()
        self.until(is_enabled, "enabled")

    def bus(self, name: str) -> dict:
        return self.robot.health()["buses"][name]

    def device(self, name: str) -> dict:
        return self.robot.health()["devices"][name]


@contextlib.contextmanager
def running(folder: Path, raw: dict, *faults: str, node_file: Path | None = None) -> Iterator[tuple[Master, Nodes]]:
    """Nodes and master, both up and every signal measured."""
    path = write(folder, raw)
    nodes = Nodes(node_file or path, *faults)
    try:
        with Master(load_robot(path)) as master:
            master.until_whole("every signal measured")
            yield master, nodes
            assert master.failure is None, repr(master.failure)
            assert not master.stale_but_valid
    finally:
        nodes.close()


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


def send_error_frame(channel: str, kind: int, data: bytes = bytes(8)) -> None:
    """What a controller's driver tells the kernel, from a raw socket: vcan passes it on to every listener."""
    with can.Bus(interface="socketcan", channel=channel) as bus:
        bus.send(can.Message(arbitration_id=kind, is_error_frame=True, data=data, dlc=8))


def main(robot_file: str, *faults: str) -> None:
    from simulators.robots.bench import simulator

    rig = simulator.rig(load_robot(robot_file), "bench", 0)
    for fault in faults:
        rig.fault(fault)
    ending = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ending.set())
    rig.start()
    ending.wait()
    rig.stop()


if __name__ == "__main__":
    main(*sys.argv[1:])
