"""Where a kind of device is put to the test: in lockstep on a `virtual` bus, or in real time on a bus of any kind."""

import time

import numpy as np
from device_kinds import NAME, RATE
from hal_bench import Bench

from hal.errors import CommandRefused
from hal.robot import open_robot
from simulators.rig import Rig
from simulators.robots.bench.world import BenchWorld

PERIOD = 1.0 / RATE
STEP = 0.005
PATIENCE = 20.0
"""[s] of real time for anything, on a machine with other work."""


class _Stage:
    """What both kinds of stage can do; `cycle`, `open` and `close` differ."""

    kind = world = robot = sample = applied = None

    def set(self, value):
        """Put the measured quantity to a value [SI unit], as a hand or a load would."""
        self.world.break_part(f"set:{self.element}:{value}")

    @property
    def element(self):
        return self.kind.hardware()[0].element

    @property
    def truth(self):
        """The main quantity as it is [SI unit]."""
        signal, _, _ = self.element.partition(".")
        return float(self.world.truth()[signal][0])

    @property
    def value(self):
        """The main quantity as it was measured [SI unit]; NaN if not valid."""
        return float(self.sample.values[self.kind.main][0])

    def read(self):
        """What the device has of the main quantity between two cycles [SI unit]."""
        device = self.robot._devices[0]
        return float(device.read().values[device.measures.index(f"{self.kind.main}.one")])

    @property
    def is_valid(self):
        return bool(self.sample.valid[self.kind.main][0])

    @property
    def is_powered(self):
        """Whether the simulated drive does anything by itself."""
        return any(enabled for _, enabled in self.world._servos.values())

    @property
    def health(self):
        return self.robot.health()["devices"][NAME]

    @property
    def is_ready(self):
        """Whether all devices are there, and what they measure too."""
        states = {device["state"] for device in self.robot.health()["devices"].values()}
        return self.sample is not None and self.is_valid and states == {"ready"}

    def settle(self):
        """Until all is ready; a device whose watchdog ran out before the first cycle is reset."""
        self.until(lambda: self.is_valid_at_all, "opening")
        self.cycle(20)
        self.robot.reset()
        self.until(lambda: self.is_ready, "being ready")

    @property
    def is_valid_at_all(self):
        return self.sample is not None and self.is_valid

    def enable(self):
        self.until(lambda: self.is_ready, "being ready")
        self.robot.enable()
        self.until(lambda: self.robot.mode == "hold", "enabling")

    def enable_again(self, tries=3):
        """Reset and enable, as a person does it: again if the device only now tells that it had to be configured."""
        for _ in range(tries):
            self.until(self.is_reset, "being reset")
            self.until(lambda: self.is_ready, "being ready again")
            self.robot.enable()
            self.until(lambda: self.robot.mode in ("hold", "fault"), "enabling")
            if self.robot.mode == "hold":
                return
        raise AssertionError(self.robot.fault_text)

    def is_reset(self):
        """Reset; whether that was taken."""
        try:
            self.robot.reset()
        except CommandRefused:
            return False
        return True

    def follow(self, value, cycles):
        """Command the same set-point [SI unit] in every cycle."""
        for _ in range(cycles):
            self.robot.command(np.array([value]), self.sample.cycle)
            self.cycle()

    def refuses_to_enable(self):
        try:
            self.robot.enable()
        except CommandRefused:
            return True
        return False


class LockStage(Bench, _Stage):
    """Moved by hand, a frame at a time."""

    def __init__(self, kind, config=None):
        self.kind = kind
        config = config or kind.config()
        super().__init__(config, nodes=kind.hardware(), world=BenchWorld(config))
        self.set(kind.value)

    def pass_time(self, duration=PERIOD):
        steps = max(round(duration / STEP), 1)
        for _ in range(steps):
            self.clock.advance(duration / steps)
            if self.powered:
                self.rig.step(duration / steps)
            self.flush()

    def enable(self):
        _Stage.enable(self)

    def follow(self, desired, cycles=1):
        _Stage.follow(self, desired, cycles)


class LiveStage(_Stage):
    """In real time, with the threads of both sides."""

    def __init__(self, kind, bus):
        self.kind = kind
        self.config = kind.config(bus)
        self.world = BenchWorld(self.config)
        self.set(kind.value)
        self.rig = Rig(self.config, self.world, kind.hardware())
        self.robot = open_robot(self.config)

    def open(self):
        self.rig.start()
        self.robot.open()
        self._due = time.monotonic()
        return self

    def close(self):
        self.robot.close()
        self.rig.stop()

    def cycle(self, count=1):
        for _ in range(count):
            self.sample, self.applied = self.robot.cycle()
            self._due = max(self._due + PERIOD, time.monotonic())
            time.sleep(max(self._due - time.monotonic(), 0.0))
        return self.sample, self.applied

    def until(self, condition, what):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, f"{what}: {self.robot.health()}"
            self.cycle()
