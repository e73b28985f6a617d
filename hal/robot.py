"""Named devices read and commanded together: one coherent sample per cycle, and one mode for all drives."""

import threading
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from hal.bus import Bus, BusClock, BusState
from hal.caretaker import Caretaker
from hal.clock import Clock, SystemClock
from hal.config import RobotConfig
from hal.device import Device
from hal.errors import CommandRefused, ConfigError
from hal.fleet import build
from hal.limits import Limiter
from hal.modes import Mode, ModeMachine
from hal.sample import Applied, Assembler, Sample
from hal.watchdog import CommandWatchdog

__all__ = ["Applied", "Robot", "Sample", "open_robot"]

ANSWER_SHARE = 0.6
"""Part of the period that the cycle waits for the answers to its SYNC."""
START_MEMORY = 0.25
"""The robot may be enabled where all its drives were seen not longer ago [s]: a lost frame is no obstacle."""
CLOSING_CYCLES = 20
"""How many cycles `close` spends on letting the drives go."""


class Robot:
    """A robot: its devices, its limits, and the turn of its cycle.

    Somebody calls `cycle` at `config.rates.hal`; the other methods may be called from any thread and only ask. Nothing
    is enabled by itself, at no time.
    """

    def __init__(
        self,
        config: RobotConfig,
        devices: Sequence[Device],
        buses: Sequence[Bus] = (),
        clock: Clock | None = None,
        source: str = "can",
    ) -> None:
        """Put a robot together; nothing is opened yet.

        Raises:
            ConfigError: The devices do not measure each element once, or do not command each element once.
        """
        self.config = config
        self.period = 1.0 / config.rates.hal
        self.source = source
        self._devices = tuple(devices)
        self._buses = tuple(buses)
        self._clock: Clock = clock or SystemClock()
        self._lock = threading.RLock()
        self._assembler = Assembler(config, devices)
        self._limiter = Limiter(config, self.period)
        self._watchdog = CommandWatchdog(config.command.time_to_live, self.period)
        actuators = [device for device in devices if device.commands]
        self._modes = ModeMachine(actuators, config.command)
        self._commanded = tuple(zip(actuators, _places(config, actuators), strict=True))
        self._caretaker = Caretaker(devices) if self._buses else None
        size = config.signals[config.command.signal].size
        self._nothing = np.full(size, np.nan)
        self._nothing.flags.writeable = False
        self._set_point = self._nothing
        self._position = self._nothing
        self._position_known = -np.inf
        self._desired: tuple[np.ndarray, float] | None = None
        self._measured = {name: np.full(config.signals[name].size, np.nan) for name in self._assembler.signals}
        self._number = 0
        self._incomplete = 0
        self._is_open = False
        self._stop_reason = ""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def mode(self) -> str:
        """`off`, `enabling`, `hold`, `follow`, `stopping` or `fault`."""
        return self._modes.mode.value

    @property
    def fault_text(self) -> str:
        """Why the robot is in fault; empty if it is not."""
        return self._modes.fault_text

    @property
    def clock(self) -> Clock:
        """What the cycle goes by; whoever calls `cycle` sleeps on it."""
        return self._clock

    def open(self) -> None:
        """Open the buses and commission every node, all at once; blocks until each was tried.

        A node on a bus that does not answer is told by `health` and tried again until it does. Without buses, what a
        device's `open` raises is passed on.
        """
        if self._is_open:
            return
        self._is_open = True
        for bus in self._buses:
            bus.open()
        if self._caretaker:
            self._caretaker.start()
            return
        for device in self._devices:
            device.open()

    def close(self) -> None:
        """Let the drives go and give everything back. Safe to call twice."""
        if not self._is_open:
            return
        self._is_open = False
        self.disable()
        for _ in range(CLOSING_CYCLES):
            if self._modes.mode in (Mode.OFF, Mode.FAULT):
                break
            self.cycle()
        if self._caretaker:
            self._caretaker.stop()
        else:
            for device in self._devices:
                device.close()
        for bus in self._buses:
            bus.close()

    def enable(self) -> None:
        """Ask the drives to hold where the robot is; `mode` becomes `hold` when all do.

        Raises:
            CommandRefused: In fault or stopping, a drive is not ready, or its position is not known.
        """
        with self._lock:
            if self._modes.mode is Mode.OFF:
                self._check_start()
                self._desired = None
                self._set_point = self._position.copy()
            self._modes.enable(self._clock.monotonic())

    def _check_start(self) -> None:
        """Whether the robot is where it may be enabled."""
        signal = self.config.command.signal
        names = self.config.signals[signal].elements
        if self._clock.monotonic() - self._position_known > START_MEMORY:
            unknown = [
                name for name, value in zip(names, self._measured[signal], strict=True) if not np.isfinite(value)
            ]
            raise CommandRefused(
                f"No valid {signal} of {', '.join(unknown or names)}, so there is nothing to start from. "
                "Is the cycle running, does the drive answer?"
            )
        misplaced = self._limiter.misplaced(self._position)
        if misplaced:
            told = ", ".join(f"{names[index]} {self._position[index]:.4g}" for index in misplaced)
            raise CommandRefused(f"Far outside limits.{signal}: {told}. Are zero and direction of these drives right?")

    def disable(self) -> None:
        """Let go at once."""
        with self._lock:
            self._modes.disable(self._clock.monotonic())

    def stop(self, reason: str) -> None:
        """Hold at once, take no more commands, and let go after the robot file's `command.hold`."""
        with self._lock:
            self._stop_reason = reason
            self._modes.stop(self._clock.monotonic())

    def reset(self) -> None:
        """Leave the fault, here and in the drives; enables nothing.

        Raises:
            CommandRefused: The robot is enabled.
        """
        with self._lock:
            self._modes.reset()
            for device in self._devices:
                device.reset()

    def command(self, desired: np.ndarray, cycle: int) -> None:
        """Ask for set-points; the newest wins, and lives `command.time_to_live` from the cycle that it answers.

        Args:
            desired: Set-points [unit of the commanded signal], shape (n,).
            cycle: Number of the sample from which they were computed.

        Raises:
            CommandRefused: A wrong size, not finite, the robot is not enabled, the cycle unknown or too long ago.
        """
        desired = np.array(desired, float)
        signal = self.config.command.signal
        if desired.shape != self._nothing.shape:
            raise CommandRefused(f"A command of {signal} has {self._nothing.size} values, not shape {desired.shape}.")
        finite = np.isfinite(desired)
        if not finite.all():
            name = self.config.signals[signal].elements[int(np.argmin(finite))]
            raise CommandRefused(f"The command's {signal}.{name} is {desired[np.argmin(finite)]}; it must be finite.")
        with self._lock:
            expires = self._watchdog.expiry(cycle, self._clock.monotonic())
            if not self._modes.takes_commands:
                raise CommandRefused(
                    f"The robot is in mode '{self.mode}' and takes commands in 'hold' and 'follow'. "
                    f"{self.fault_text or 'Is it enabled?'}"
                )
            self._desired = (desired, expires)

    def cycle(self) -> tuple[Sample, Applied]:
        """One whole turn: limits, set-points, SYNC on all buses, the answers, the sample."""
        for bus in self._buses:
            bus.begin()
        with self._lock:
            start = self._clock.monotonic()
            stamp = self._clock.now_ns()
            self._number += 1
            applied = self._act(start, stamp)
            self._watchdog.note(self._number, start)
        for bus in self._buses:
            bus.sync(start)
        complete = True
        for bus in self._buses:
            complete &= bus.wait(start + ANSWER_SHARE * self.period)
        values, age, valid = self._assembler.assemble(self._clock.monotonic())
        self._measured = values
        position = values[self.config.command.signal]
        if np.isfinite(position).all():
            self._position, self._position_known = position, start
        self._incomplete += not complete
        return Sample(self._number, stamp, self.source, complete, values, age, valid), applied

    def _act(self, now: float, stamp: int) -> Applied:
        """Move on to this cycle's mode and send its set-points."""
        modes = self._modes
        if modes.mode is not Mode.OFF and modes.mode is not Mode.FAULT:
            problem = self._limiter.trip(self._measured) or self._bus_problem()
            if problem:
                modes.fault(problem)
        desired = self._desired
        if desired is not None and (now > desired[1] or not modes.takes_commands):
            self._desired = desired = None
        modes.step(now, desired is not None)
        limited: list[str] = []
        if modes.powered:
            limited = self._move(desired[0] if desired else None)
            for device, places in self._commanded:
                device.apply(self._set_point[places])
        else:
            self._set_point = self._nothing
            for device, _ in self._commanded:
                device.idle()
        return Applied(
            self._number,
            stamp,
            modes.mode.value,
            self.config.command.signal,
            desired[0] if desired else self._nothing,
            self._set_point,
            limited,
        )

    def _move(self, desired: np.ndarray | None) -> list[str]:
        """Take the set-point one step on; while enabling it is where the robot is, so that nothing jumps."""
        if self._modes.mode is Mode.ENABLING:
            measured = self._measured[self.config.command.signal]
            self._set_point = np.where(np.isfinite(measured), measured, self._set_point)
            return []
        wanted = self._set_point if desired is None else desired
        self._set_point, limited = self._limiter.step(wanted, self._set_point, self._measured, desired is not None)
        return limited

    def _bus_problem(self) -> str:
        for bus in self._buses:
            if bus.state in (BusState.GONE, BusState.BUS_OFF):
                return f"Bus '{bus.name}' is {bus.state}. {bus.text}"
        return ""

    def health(self) -> dict[str, Any]:
        """Mode, buses and devices in plain values: for status messages, not for control."""
        devices = {}
        for device in self._devices:
            health = device.health()
            devices[device.name] = {
                "state": health.state.value,
                "text": health.text,
                "counters": dict(health.counters),
            }
        blind = self._limiter.blind(self._measured)
        return {
            "mode": self.mode,
            "fault": self.fault_text,
            "stop_reason": self._stop_reason,
            "cycles": self._number,
            "incomplete": self._incomplete,
            "limits": f"The tension limit cannot act without a valid tension of {', '.join(blind)}." if blind else "",
            "buses": {bus.name: bus.health() for bus in self._buses},
            "devices": devices,
        }


def _places(config: RobotConfig, actuators: Sequence[Device]) -> list[np.ndarray]:
    """For each actuator, where its commanded elements lie in the commanded signal."""
    signal = config.command.signal
    names = [f"{signal}.{element}" for element in config.signals[signal].elements]
    commanded = [element for device in actuators for element in device.commands]
    if sorted(commanded) != sorted(names):
        wrong = sorted(set(names) ^ set(commanded)) or sorted({e for e in commanded if commanded.count(e) > 1})
        raise ConfigError(
            f"The devices of '{config.robot}' must command each element of '{signal}' once; "
            f"that fails for {', '.join(wrong)}."
        )
    return [np.array([names.index(element) for element in device.commands]) for device in actuators]


def open_robot(config: RobotConfig, clock: BusClock | None = None) -> Robot:
    """Build the buses and drivers that a robot file names; nothing is opened yet.

    Raises:
        ConfigError: An unknown driver or interface, settings that do not fit, or a bus that would carry too much.
    """
    clock = clock or SystemClock()
    buses, devices = build(config, clock)
    simulated = bool(config.buses) and all(bus.interface in ("hub", "virtual") for bus in config.buses.values())
    return Robot(config, devices, buses, clock, "simulated" if simulated else "can")
