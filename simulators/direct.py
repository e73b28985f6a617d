"""A world as a hal device without a bus, and its clock: faster than real time, for data collection."""

import time
from collections.abc import Mapping

import numpy as np
from typing_extensions import override

from hal.config import RobotConfig
from hal.device import Device, DeviceHealth, DeviceState, Reading
from hal.robot import Robot
from simulators.world import World


class WorldClock:
    """A clock that steps the world in place of sleeping, so that a cycle takes only its computation time."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._now = 0.0
        self._start_ns = time.time_ns()

    def monotonic(self) -> float:
        """Return the simulated time [s]."""
        return self._now

    def now_ns(self) -> int:
        """Return the wall-clock time at the start of this clock plus the simulated time [ns since 1970]."""
        return self._start_ns + round(self._now * 1e9)

    def sleep_until(self, deadline: float) -> None:
        """Step the world until the deadline; return at once when it has passed."""
        duration = deadline - self._now
        if duration > 0.0:
            self._world.step(duration)
            self._now = deadline


class DirectDevice(Device):
    """All sensors, cameras and servos of a world in one device; it has no faults and is never silent."""

    def __init__(self, config: RobotConfig, world: World, clock: WorldClock, name: str = "direct") -> None:
        self.name = name
        self._signals = tuple(name for name, signal in config.signals.items() if signal.computed is None)
        self.measures = tuple(config.element_names(self._signals))
        signal = config.command.signal
        self.commands = tuple(f"{signal}.{element}" for element in config.signals[signal].elements)
        self._commanded = signal
        self._world = world
        self._clock = clock
        self._state = DeviceState.CLOSED

    @override
    def open(self) -> None:
        self._state = DeviceState.READY

    @override
    def read(self) -> Reading:
        """Measure the world now."""
        measured: Mapping[str, np.ndarray] = self._world.measure()
        values = np.concatenate([measured[signal] for signal in self._signals])
        return Reading(values, np.full(len(values), self._clock.monotonic()))

    @override
    def health(self) -> DeviceHealth:
        return DeviceHealth(self._state)

    @override
    def enable(self) -> None:
        """Enable all servos at their present lengths."""
        self._drive(self._world.truth()[self._commanded], True)
        self._state = DeviceState.ENABLED

    @override
    def disable(self) -> None:
        """Disable all servos; the brakes hold."""
        if self._state is DeviceState.ENABLED:
            self._drive(self._world.truth()[self._commanded], False)
            self._state = DeviceState.READY

    @override
    def apply(self, values: np.ndarray) -> None:
        """Set the targets of all servos; do nothing unless enabled."""
        if self._state is DeviceState.ENABLED:
            self._drive(values, True)

    @override
    def close(self) -> None:
        """Disable all servos and close the world."""
        if self._state is not DeviceState.CLOSED:
            self.disable()
            self._state = DeviceState.CLOSED
            self._world.close()

    def _drive(self, targets: np.ndarray, enabled: bool) -> None:
        for element, target in zip(self.commands, targets.tolist(), strict=True):
            self._world.drive(element, target, enabled)


def direct_robot(config: RobotConfig, world: World) -> Robot:
    """Return a robot made of a world without a bus, as fast as it computes, not opened yet."""
    clock = WorldClock(world)
    device = DirectDevice(config, world, clock)
    return Robot(config, devices=[device], buses=(), clock=clock, source="simulated")
