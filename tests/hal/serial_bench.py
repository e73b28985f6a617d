"""A robot of three servos on a serial line, with simulated servos behind a pseudo-terminal."""

import contextlib
import itertools
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from hal.config import RobotConfig
from hal.robot import open_robot
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.serial.node import SerialConstants
from simulators.rig import Rig
from simulators.robots.bench.world import BenchWorld

RATE = 100.0
NAMES = ("pan", "lift", "elbow")
NODES = (1, 2, 5)
PATIENCE = 20.0
SETTINGS = {
    "feetech": {"allow_no_watchdog": True, "silent_after": 0.6},
    "dynamixel": {"model": "XM430-W350", "silent_after": 0.6},
}
"""A busy machine may stop the simulated servos for longer than the 0.15 s after which a servo counts as silent."""
DIRECTIONS, ZEROS = (1, -1, 1), (0.0, 0.1, -0.2)
_numbers = itertools.count()
_folder = tempfile.TemporaryDirectory()
"""The terminals' links and locks are here; it is removed when the tests end."""


def robot_file(make, settings=None, folder=None, quantities=("position", "velocity"), **over):
    """The robot file; every servo has another sign and zero."""
    folder = folder or _folder.name
    signal = {"unit": "rad", "elements": list(NAMES), "stale_after": 0.05}
    signal["plausible"] = {"low": -99, "high": 99, "rate": 1e9}  # the bench moves by hand in no time
    units = {"velocity": "rad/s", "load": "1", "current": "A", "effort": "N m", "voltage": "V", "temperature": "degC"}
    signals = {"joint_position": signal}
    for quantity in quantities[1:]:
        signals[f"joint_{quantity}"] = {"unit": units[quantity], "elements": list(NAMES), "stale_after": 0.05}
    devices = {}
    for name, node, direction, zero in zip(NAMES, NODES, DIRECTIONS, ZEROS, strict=True):
        devices[f"{name}_servo"] = {
            "kind": "servo",
            "bus": "arm",
            "node": node,
            "elements": {quantity: f"joint_{quantity}.{name}" for quantity in quantities},
            "settings": {"direction": direction, "zero": zero},
        }
    body = {
        "robot": "serial_arm",
        "signals": signals,
        "command": {"signal": "joint_position", "time_to_live": 0.1, "hold": 0.3},
        "limits": {"joint_position": {"low": -1.5, "high": 1.5, "rate": 3.0}},
        "rates": {"hal": RATE},
        "buses": {"arm": {"interface": "pty", "channel": f"{folder}/line_{next(_numbers)}"}},
        "kinds": {"servo": {"driver": make, "settings": {**SETTINGS[make], **(settings or {})}}},
        "devices": devices,
    }
    return RobotConfig.model_validate({**body, **over})


def constants(make, index, **over):
    """Of the servo of one joint, as the robot file describes it."""
    model = {"feetech": 777, "dynamixel": 1020}[make]
    return SerialConstants(make, model=model, direction=DIRECTIONS[index], zero=ZEROS[index], **over)


class SerialBench:
    """The robot and its simulated servos, in real time."""

    def __init__(self, make, config=None, **over):
        self.make = make
        self.config = config or robot_file(make)
        self._over = over
        self.rig = self.world = None
        self.robot = open_robot(self.config)
        self._due = 0.0
        self.sample = self.applied = None

    def __enter__(self):
        # Real servos have processors of their own; other programs must not delay the simulated ones.
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        self.plug()
        self.robot.open()
        self._due = time.monotonic()
        return self

    def __exit__(self, *_):
        self.robot.close()
        self.unplug()

    def plug(self):
        """Start the servos and their terminal."""
        self.world = BenchWorld(self.config)
        specs = [
            NodeSpec(f"{name}_servo", "arm", node, f"joint_position.{name}", constants(self.make, i, **self._over))
            for i, (name, node) in enumerate(zip(NAMES, NODES, strict=True))
        ]
        self.rig = Rig(self.config, self.world, specs)
        self.rig.start()

    def unplug(self):
        """End the terminal, as a pulled adapter does."""
        if self.rig:
            self.rig.stop()
        self.rig = None

    def cycle(self, count=1, command=None):
        """Run cycles in real time; a command [rad] answers the newest sample."""
        for _ in range(count):
            if command is not None and self.sample is not None:
                self.robot.command(np.asarray(command, float), self.sample.cycle)
            self.sample, self.applied = self.robot.cycle()
            self._due = max(self._due + 1 / RATE, time.monotonic() - 1 / RATE)
            time.sleep(max(0.0, self._due - time.monotonic()))

    def until(self, condition, what):
        """Cycle until it is so."""
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"{what} took more than {PATIENCE:g} s: {self.robot.health()}"
            self.cycle()

    def settle(self):
        """Cycle until all servos are ready and measured."""
        self.until(lambda: self.states() == {"ready"} and self.is_measured, "becoming ready")
        self.cycle(5)

    def enable(self):
        """Enable the robot."""
        self.settle()
        self.robot.enable()
        self.until(lambda: self.robot.mode == "hold", "enabling")

    @property
    def is_measured(self):
        return self.sample is not None and bool(self.sample.valid["joint_position"].all())

    def states(self):
        return {device["state"] for device in self.robot.health()["devices"].values()}

    def health(self, name):
        return self.robot.health()["devices"][f"{name}_servo"]

    @property
    def line(self):
        return self.robot.health()["buses"]["arm"]

    def node(self, name):
        return self.rig.node(f"{name}_servo")

    def set(self, name, value):
        """Put a joint to an angle [rad], as a hand does."""
        self.world.break_part(f"set:joint_position.{name}:{value}")

    @property
    def positions(self):
        return self.sample.values["joint_position"]

    @property
    def truth(self):
        return self.world.truth()["joint_position"]

    @contextlib.contextmanager
    def memory(self, name):
        """The registers of a servo, while it does not answer."""
        node = self.node(name)
        with self.rig._segments["arm"].lock:
            yield node


def path(bench):
    """The link to the terminal."""
    return Path(bench.config.buses["arm"].channel)
