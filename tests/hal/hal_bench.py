"""A small robot for the tests of `hal`: two muscles and a joint on two buses, its nodes, and a clock moved by hand."""

import itertools
import threading
import time
from pathlib import Path

import can
import numpy as np

from hal.clock import ManualClock
from hal.config import RobotConfig
from hal.robot import Robot, open_robot
from simulators.nodes.canopen.spec import CellConstants, DriveConstants, EncoderConstants, NodeSpec
from simulators.rig import Rig

ROBOTS = Path(__file__).resolve().parents[2] / "robots"
SENTINEL = 0x7FE
PATIENCE = 100
"""Looks, and not seconds, that a frame may need: a machine that stands still as a whole says nothing of a thread."""
REAL_TIME_LIMIT = 30.0
_numbers = itertools.count()

DRIVE = {"eds": "eds/servo_drive.eds", "counts_per_turn": 4096, "gear": 29, "spool_radius": 0.008, "rated_torque": 0.1}


def description(interface: str = "virtual", **changes):
    """A robot file as a mapping; `changes` replace whole sections."""
    number = next(_numbers)
    body = {
        "robot": "bench",
        "signals": {
            "joint_position": {"unit": "rad", "elements": ["elbow"]},
            "muscle_tension": {"unit": "N", "elements": ["biceps", "triceps"]},
            "muscle_length": {"unit": "m", "elements": ["biceps", "triceps"]},
        },
        "command": {"signal": "muscle_length", "time_to_live": 0.1, "hold": 0.5},
        "limits": {
            "muscle_tension": {"soft_high": 200, "trip_high": 400},
            "muscle_length": {"low": 0.1, "high": 0.5, "rate": 0.25},
        },
        "rates": {"hal": 200},
        "buses": {
            "can0": {"interface": interface, "channel": f"hal_bench_{number}_0"},
            "can1": {"interface": interface, "channel": f"hal_bench_{number}_1"},
        },
        "kinds": {
            "drive": {"driver": "cia402", "settings": DRIVE},
            "cell": {"driver": "cia404", "settings": {"eds": "eds/load_cell.eds"}},
            "encoder": {"driver": "cia406", "settings": {"eds": "eds/joint_encoder.eds", "zero": -np.pi}},
        },
        "devices": {
            "biceps_drive": {"kind": "drive", "bus": "can0", "node": 1, "element": "muscle_length.biceps"},
            "triceps_drive": {"kind": "drive", "bus": "can1", "node": 2, "element": "muscle_length.triceps"},
            "biceps_cell": {"kind": "cell", "bus": "can0", "node": 11, "element": "muscle_tension.biceps"},
            "triceps_cell": {"kind": "cell", "bus": "can1", "node": 12, "element": "muscle_tension.triceps"},
            "elbow_encoder": {"kind": "encoder", "bus": "can1", "node": 21, "element": "joint_position.elbow"},
        },
        "folder": ROBOTS,
    }
    return {**body, **changes}


def hardware():
    """What really hangs on the buses."""
    return [
        NodeSpec("biceps_drive", "can0", 1, "muscle_length.biceps", DriveConstants(load="muscle_tension.biceps")),
        NodeSpec("triceps_drive", "can1", 2, "muscle_length.triceps", DriveConstants(load="muscle_tension.triceps")),
        NodeSpec("biceps_cell", "can0", 11, "muscle_tension.biceps", CellConstants()),
        NodeSpec("triceps_cell", "can1", 12, "muscle_tension.triceps", CellConstants()),
        NodeSpec("elbow_encoder", "can1", 21, "joint_position.elbow", EncoderConstants()),
    ]


class BenchWorld:
    """Two wires whose lengths follow their servos at 0.5 m/s at most; tensions and angle are what the test sets."""

    def __init__(self):
        self.time = 0.0
        self.length = np.array([0.30, 0.25])
        self.tension = np.array([20.0, 30.0])
        self.angle = np.array([-0.7])
        self.drives = {}

    def step(self, duration):
        self.time += duration
        for index, name in enumerate(("biceps", "triceps")):
            target, enabled = self.drives.get(f"muscle_length.{name}", (0.0, False))
            if enabled:
                way = 0.5 * duration
                self.length[index] += np.clip(target - self.length[index], -way, way)

    def measure(self):
        return {
            "joint_position": self.angle.copy(),
            "muscle_tension": self.tension.copy(),
            "muscle_length": self.length.copy(),
        }

    truth = measure

    def drive(self, element, target, enabled):
        self.drives[element] = (target, enabled)

    def break_part(self, part):
        raise ValueError(f"The bench has no part '{part}'.")

    def close(self):
        pass


class BenchClock(ManualClock):
    """Waiting for an answer is letting the other end of the wire have its turn."""

    turn = staticmethod(lambda: None)

    def wait(self, event, deadline):
        self.turn()
        return event.is_set()


ENABLING = 60
"""Cycles to enable in: an axis whose watchdog ran out is reset before, and its heartbeat, which comes every 20 cycles,
confirms one after the other."""


class Bench:
    """Robot and rig on `virtual` buses, moved in lockstep, so that a test of time needs no time."""

    def __init__(self, config=None, powered=True, nodes=None, world=None, clock=None):
        self.config = config or RobotConfig.model_validate(description())
        self.clock = clock or BenchClock()
        self.world = world or BenchWorld()
        self.rig = Rig(self.config, self.world, nodes or hardware())
        self.robot: Robot = open_robot(self.config, self.clock)
        self.buses = {bus.name: bus for bus in self.robot._buses}
        self.wires = {
            name: can.Bus(interface="virtual", channel=bus.channel) for name, bus in self.config.buses.items()
        }
        self._passed = {name: threading.Event() for name in self.wires}
        for name, bus in self.buses.items():
            bus.subscribe(SENTINEL, lambda data, received, name=name: self._passed[name].set())
        self.clock.turn = self.turn
        self.powered = powered
        self.goes_by_itself = any(device.patience > 1 for device in self.robot._devices)
        """Whether a device sends by its own clock, for which a cycle does not wait."""
        self.sample = self.applied = None

    def turn(self):
        """The nodes answer what they were sent, and the robot's receive threads take in all that was sent so far."""
        if self.powered:
            self.rig.step(0.0)
        self.flush()

    def flush(self):
        """Wait until the receive threads have handled every frame that is on the wires now."""
        for name, wire in self.wires.items():
            bus, passed = self.buses[name], self._passed[name]
            interface = bus._can
            if bus.counters["opened"] and interface is not None:
                passed.clear()
                wire.send(can.Message(arbitration_id=SENTINEL, is_extended_id=False))
                for _ in range(PATIENCE):
                    if passed.wait(0.02) or bus._can is not interface:  # one opened anew was never sent it
                        break
                else:
                    raise AssertionError(f"{name} does not receive: {bus.health()}, {bus._arrival.since}")

    def flush_errors(self, bus):
        """Wait until an error frame was handled, without a data frame behind it that would end bus-off."""
        deadline = time.monotonic() + 2.0
        while not self.buses[bus].counters["error_frames"]:
            assert time.monotonic() < deadline
            time.sleep(0.001)

    def pass_time(self, duration=0.005):
        self.clock.advance(duration)
        if self.powered:
            self.rig.step(duration)

    def cycle(self, count=1):
        """`count` cycles; the newest sample and what was applied are kept."""
        for _ in range(count):
            self.pass_time()
            if self.goes_by_itself:
                self.flush()
            self.sample, self.applied = self.robot.cycle()
        return self.sample, self.applied

    def until(self, condition, what, cycles=4000):
        """Cycle until a condition holds; the robot's caretaker works in real time meanwhile."""
        deadline = time.monotonic() + REAL_TIME_LIMIT
        for _ in range(cycles):
            if condition():
                return
            assert time.monotonic() < deadline, f"{what}: {self.robot.health()}"
            self.cycle()
            time.sleep(0.001)
        raise AssertionError(f"{what}: {self.robot.health()}")

    def while_time_passes(self, job):
        """Run something that blocks on the nodes' answers."""
        thread = threading.Thread(target=job)
        thread.start()
        while thread.is_alive():
            self.pass_time()
            time.sleep(0.0005)
        thread.join()

    def open(self):
        if self.powered:
            self.rig.step(0.0)
        self.while_time_passes(self.robot.open)
        return self

    def close(self):
        self.while_time_passes(self.robot.close)
        self.rig.stop()
        for wire in self.wires.values():
            wire.shutdown()

    def enable(self):
        self.cycle(2)
        self.robot.enable()
        self.until(lambda: self.robot.mode == "hold", "enabling", ENABLING)

    def follow(self, desired, cycles=1):
        """Command the same set-point in every cycle."""
        for _ in range(cycles):
            self.robot.command(np.array(desired), self.sample.cycle)
            self.cycle()

    def device(self, name):
        return self.robot.health()["devices"][name]

    def states(self):
        return {device["state"] for device in self.robot.health()["devices"].values()}

    def send(self, bus, cob_id, data, **more):
        """A frame from nowhere."""
        self.wires[bus].send(can.Message(arbitration_id=cob_id, data=bytes(data), is_extended_id=False, **more))
