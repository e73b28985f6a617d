"""The bench with a wire that can be broken, a world that remembers, and a referee who looks at every cycle."""

import logging
import threading
import time
from collections import deque

import can
import numpy as np
from hal_bench import Bench, BenchClock, BenchWorld, description

from hal.config import RobotConfig
from hal.errors import CommandRefused
from simulators.nodes.canopen.spec import CellConstants, DriveConstants, EncoderConstants, NodeSpec
from simulators.rig import Rig
from simulators.wire_faults import FaultyWire

RATE = 100.0
PERIOD = 1.0 / RATE
STEP = 0.005
TENSION_RAMP, ANGLE_RAMP = 1.0, 0.01
"""Of what is measured [N/s, rad/s], so that a value tells when it was true."""
LEAST_TENSION = 5.0
"""The muscles of this robot are never slack [N]."""
MEMORY = 4.0
"""How far back [s] the world remembers its lengths."""
DRIVES = ("muscle_length.biceps", "muscle_length.triceps")
STRAY = "stray_length.stray"
LET_GO = 0.8
"""A drive may take so long [s] to be without power after the robot went into fault: 0.15 s until it misses the HAL's
heartbeat, 0.5 s for the longest quick stop, and the cycles until it is told where it is."""
UNDERWAY = 2.5 * PERIOD
"""A drive may still become enabled by a request that was sent before the fault [s]."""
WINDOW = 60
"""Steps of the world over which speed is averaged: lost set-points are caught up within them,"""
CATCH_UP = 1.5
"""at this multiple of the limit."""
REACH = 40
"""A drive is where a set-point of the last so many cycles was, or between two of them,"""
BEYOND = 0.002
"""or further by what it needs to stop [m]."""


def wire_description():
    """Two drives and a cell on one bus, a cell and an encoder on the other, at 100 Hz."""
    body = description(rates={"hal": RATE})
    body["limits"]["muscle_length"]["acceleration"] = 2.0
    body["limits"]["joint_position"] = {"low": -1.2, "high": 0.2}
    body["signals"]["muscle_tension"]["plausible"] = {"low": LEAST_TENSION}
    body["devices"]["triceps_drive"]["bus"] = "can0"
    body["signals"]["stray_length"] = {"unit": "m", "elements": ["stray"], "source": "vision"}
    return body


def wire_hardware():
    """What hangs on the wires; `stray_drive` has the node id of another one, and no power."""
    return [
        NodeSpec("biceps_drive", "can0", 1, DRIVES[0], DriveConstants(load="muscle_tension.biceps")),
        NodeSpec("triceps_drive", "can0", 2, DRIVES[1], DriveConstants(load="muscle_tension.triceps")),
        NodeSpec("stray_drive", "can0", 1, STRAY, DriveConstants()),
        NodeSpec("biceps_cell", "can0", 11, "muscle_tension.biceps", CellConstants()),
        NodeSpec("triceps_cell", "can1", 12, "muscle_tension.triceps", CellConstants()),
        NodeSpec("elbow_encoder", "can1", 21, "joint_position.elbow", EncoderConstants()),
    ]


class WitnessWorld(BenchWorld):
    """Tensions and angle grow steadily; lengths and whoever was enabled are remembered."""

    def __init__(self):
        super().__init__()
        self.stray = np.array([0.2])
        self.history = deque(maxlen=round(MEMORY / STEP))
        self.rises = []
        self.stuck = {}
        """`muscle_length.element` -> length at which its motor is blocked [m]."""

    def step(self, duration):
        super().step(duration)
        target, enabled = self.drives.get(STRAY, (0.0, False))
        if enabled:
            self.stray += np.clip(target - self.stray, -0.5 * duration, 0.5 * duration)
        for index, element in enumerate(DRIVES):
            if element in self.stuck:
                self.length[index] = self.stuck[element]
        self.tension = np.array([20.0, 30.0]) + TENSION_RAMP * self.time
        self.angle = np.array([-0.7]) + ANGLE_RAMP * self.time
        self.history.append((self.time, *self.length, *self.stray))

    def measure(self):
        return {**super().measure(), "stray_length": self.stray.copy()}

    truth = measure

    def drive(self, element, target, enabled):
        if enabled and not self.drives.get(element, (0.0, False))[1]:
            self.rises.append((self.time, element))
        super().drive(element, target, enabled)

    @property
    def enabled(self):
        return [element for element, (_, enabled) in self.drives.items() if enabled]

    def age_of(self, signal, index, value):
        """How long ago [s] a value was true at the latest; inf if it was not within memory."""
        if signal == "muscle_tension":
            return abs(self.time - (value - (20.0, 30.0)[index]) / TENSION_RAMP)
        if signal == "joint_position":
            return abs(self.time - (value + 0.7) / ANGLE_RAMP)
        for when, *lengths in reversed(self.history):
            if abs(lengths[index] - value) < 2e-6:
                return self.time - when
        return np.inf


class SteppedClock(BenchClock):
    """A clock whose wall time can be set by somebody else, as by NTP."""

    wall_step = 0.0

    def now_ns(self):
        return super().now_ns() + round(self.wall_step * 1e9)


class WireBench(Bench):
    """Robot and rig in lockstep, with a `FaultyWire` on each bus between them."""

    def __init__(self, seed=0):
        config = RobotConfig.model_validate(wire_description())
        super().__init__(config, nodes=wire_hardware(), world=WitnessWorld(), clock=SteppedClock())
        far = {n: b.model_copy(update={"channel": f"{b.channel}_far"}) for n, b in config.buses.items()}
        self.rig = Rig(config.model_copy(update={"buses": far}), self.world, wire_hardware())
        self.faulty = {
            name: FaultyWire(
                can.Bus(interface="virtual", channel=config.buses[name].channel),
                can.Bus(interface="virtual", channel=far[name].channel),
                seed,
            )
            for name in config.buses
        }
        self.rig.step(0.0)
        self.rig.fault("node_silent stray_drive")
        self.referee = Referee(self)

    def turn(self):
        self._exchange(0.0)

    def pass_time(self, duration=PERIOD):
        self.clock.advance(duration)
        for _ in range(max(round(duration / STEP), 1)):
            self._exchange(min(duration, STEP))

    def _exchange(self, duration):
        now = self.world.time
        for wire in self.faulty.values():
            wire.to_nodes(now)
        self.rig.step(duration)
        for wire in self.faulty.values():
            wire.to_hal(now)
        self.flush()

    def cycle(self, count=1):
        for _ in range(count):
            super().cycle()
            self.referee.look()
        return self.sample, self.applied

    def enable(self):
        self.cycle(2)
        self.referee.was_asked = True
        self.robot.enable()
        self.until(lambda: self.robot.mode == "hold", "enabling", 100)

    def ask(self, desired):
        """Command, if the robot takes commands; what it refuses, a client would have to live with too."""
        if self.robot.mode in ("hold", "follow"):
            try:
                self.robot.command(desired, self.sample.cycle)
            except CommandRefused:
                return False
        return True

    def unplug(self, bus):
        """Take away the interface that the HAL has open, and wait until it has seen that."""
        opened = self.buses[bus].counters["opened"]
        self.buses[bus]._can.shutdown()
        deadline = time.monotonic() + 5.0
        while self.buses[bus].counters["opened"] == opened:
            assert time.monotonic() < deadline, f"{bus} is not opened again"
            time.sleep(0.001)

    def close(self):
        super().close()
        for wire in self.faulty.values():
            wire.close()


class Referee(logging.Handler):
    """Writes down the first time that each rule of the robot is broken.

    Rules: `exception`, `motion` (outside limits), `stale` (an old or wrong value called valid), `enabled` (by itself),
    `power` (still there long after the fault).
    """

    def __init__(self, bench):
        super().__init__(logging.ERROR)
        self._bench = bench
        self.violations = {}
        self.was_asked = False
        self.extra_age = 0.0
        """How much later [s] than it was sent a frame may arrive."""
        self.lies = False
        """Whether frames carry wrong values, which nobody could tell from right ones."""
        self.is_hindered = False
        """Whether a drive does not do as it is asked, so that it is not where its set-points are."""
        self.forgiven = {}
        """(signal, index) -> time [s] until which a value may be wrong: a lie that has just begun."""
        self._rises = 0
        self._fault_since = None
        self._applied = deque(maxlen=REACH)
        limits = bench.config.limits["muscle_length"]
        self._low, self._high = bench.config.bounds("muscle_length")
        self._speed = limits.rate * CATCH_UP
        self._acceleration = limits.acceleration * 1.01

    def __enter__(self):
        self._hook, threading.excepthook = threading.excepthook, self._on_exception
        logging.getLogger().addHandler(self)
        return self

    def __exit__(self, *_):
        threading.excepthook = self._hook
        logging.getLogger().removeHandler(self)

    def emit(self, record):
        self._note("exception", record.getMessage())

    def _on_exception(self, args):
        self._note("exception", f"{args.thread.name}: {args.exc_value!r}")

    def _note(self, rule, text):
        self.violations.setdefault(rule, text)

    def forgive_all(self, duration):
        """For some time [s] any value may be wrong."""
        until = self._bench.world.time + duration
        for name, signal in self._bench.config.signals.items():
            self.forgiven.update({(name, index): until for index in range(signal.size)})

    def look(self):
        """Look at the cycle that has just been."""
        bench, world = self._bench, self._bench.world
        if any(bus.counters["broken_handlers"] for bus in bench.buses.values()):
            self._note("exception", "a handler raised")
        self._look_at_motion(world)
        self._look_at_set_points(bench.applied.values, world)
        if not self.lies:
            self._look_at_values(bench.sample, world)
        self._look_at_power(bench.robot.mode, world)

    def _look_at_motion(self, world):
        margin = 1e-5
        if (world.length < self._low - margin).any() or (world.length > self._high + margin).any():
            self._note("motion", f"lengths {world.length} outside {self._low}..{self._high}")
        if len(world.history) > WINDOW:
            now, before = np.array(world.history[-1]), np.array(world.history[-1 - WINDOW])
            speed = np.abs(now[1:] - before[1:]) / (now[0] - before[0])
            if (speed > self._speed + 1e-3).any():
                self._note("motion", f"speeds {speed.round(3)} m/s, allowed {self._speed:g}")

    def _look_at_set_points(self, applied, world):
        if np.isnan(applied).any():
            self._applied.clear()
            return
        self._applied.append(applied.copy())
        if len(self._applied) < 3:
            return
        points = np.array(self._applied)
        low, high = points.min(axis=0) - BEYOND, points.max(axis=0) + BEYOND
        is_beyond = (world.length < low).any() or (world.length > high).any()
        if is_beyond and not self.is_hindered:
            self._note("motion", f"lengths {world.length} beyond the set-points {low}..{high}")
        change = np.diff(points[-3:], n=2, axis=0)[0] / PERIOD**2
        if (np.abs(change) > self._acceleration).any():
            self._note("motion", f"set-points accelerate by {change.round(2)} m/s^2")

    def _look_at_values(self, sample, world):
        for signal, valid in sample.valid.items():
            oldest = self._bench.config.signals[signal].stale_after + self.extra_age + PERIOD + STEP
            for index in np.flatnonzero(valid):
                value = sample.values[signal][index]
                if np.isnan(value):
                    self._note("stale", f"{signal}[{index}] is NaN, called valid")
                    continue
                if world.time < self.forgiven.get((signal, index), -np.inf):
                    continue
                age = world.age_of(signal, index, value)
                if age > oldest:
                    self._note("stale", f"{signal}[{index}] = {value:.6g} was true {age:.3f} s ago, called valid")
                elif age > sample.age[signal][index] + self.extra_age + PERIOD + STEP:
                    self._note("stale", f"{signal}[{index}] is {age:.3f} s old, called {sample.age[signal][index]:.3f}")

    def _look_at_power(self, mode, world):
        rises, self._rises = world.rises[self._rises :], len(world.rises)
        if mode in ("off", "fault"):
            self._fault_since = world.time if self._fault_since is None else self._fault_since
            if world.time - self._fault_since > UNDERWAY:
                self.was_asked = False
            if world.time - self._fault_since > LET_GO and world.enabled:
                self._note("power", f"{', '.join(world.enabled)} still enabled in mode {mode}")
        else:
            self._fault_since = None
        if rises and not self.was_asked:
            self._note("enabled", f"{rises[0][1]} was enabled by itself at {rises[0][0]:.3f} s")
