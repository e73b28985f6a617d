"""The robot: all devices read and commanded together, with one sample per cycle and one mode for all drives."""

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from hal.actuators import Actuators, find
from hal.calibration.store import SIMULATED
from hal.caretaker import Caretaker
from hal.clock import BusClock, Clock, SystemClock
from hal.config import RobotConfig
from hal.device import Device
from hal.errors import CommandRefused
from hal.fleet import build
from hal.modes import Act, Mode, ModeMachine
from hal.safety.cycle_lock import PATIENCE, CycleLock
from hal.safety.emergency import EmergencyStop, StopResult
from hal.safety.following import Following
from hal.safety.limiter import Limiter
from hal.safety.start import Start
from hal.safety.watchdog import CommandWatchdog, CycleWatchdog, checked
from hal.sample import Applied, Assembler, Sample
from hal.wire.contract import Wire

__all__ = ["Applied", "Robot", "Sample", "open_robot"]

ANSWER_SHARE = 0.6
"""The cycle waits for this part of its period for the answers to its SYNC."""
_TRACKED = (Act.HOLD, Act.FOLLOW, Act.PARK)
"""In these cycles the drives are where their set-points are."""
CLOSING_TIME = 1.5
"""`close` waits at most this time [s] for the drives to come to rest and disable."""


class Robot:
    """A robot: its devices, its limits and its cycle.

    The owner calls `cycle` at `config.rates.hal`. All other methods may be called from any thread and only send
    requests. No drive is ever enabled without a call of `enable`.
    """

    def __init__(
        self,
        config: RobotConfig,
        devices: Sequence[Device],
        buses: Sequence[Wire] = (),
        clock: Clock | None = None,
        source: str = "can",
    ) -> None:
        """Combine the parts of a robot; nothing is opened yet.

        Raises:
            ConfigError: The devices do not measure each element once, do not command each element once, or do not
                support the limits and the stop behaviour.
        """
        self.config = config
        self.period = 1.0 / config.rates.hal
        self.source = source
        self._devices = tuple(devices)
        self._buses = tuple(buses)
        self._clock: Clock = clock or SystemClock()
        self._lock = CycleLock()
        self._assembler = Assembler(config, devices)
        self._actuators = Actuators(config, devices)
        self._limiter = Limiter(config, self.period, devices, self._actuators.quantity)
        self._watchdog = CommandWatchdog(config.command.time_to_live, self.period)
        self._cycle_watchdog = CycleWatchdog()
        self._modes = ModeMachine(self._actuators, config)
        self._emergency = EmergencyStop(config, self._actuators.devices, self._buses, self._clock, self.period)
        self._caretaker = Caretaker(devices) if self._buses else None
        self._park = None if config.stop.park is None else np.array(config.stop.park)
        self._start = Start(config, self._actuators.quantity)
        self._following = Following(config, self._actuators.devices, self._actuators.quantity)
        self._nothing = np.full(config.signals[config.command.signal].size, np.nan)
        self._nothing.flags.writeable = False
        self._desired: tuple[np.ndarray, float] | None = None
        self._measured = self._heard = self._assembler.nothing
        self._number = self._incomplete = self._answered = 0
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
        """`off`, `enabling`, `hold`, `follow`, `homing`, `stopping` or `fault`."""
        return self._modes.mode.value

    @property
    def fault_text(self) -> str:
        """Cause of the fault; empty without a fault."""
        return self._modes.fault_text

    @property
    def clock(self) -> Clock:
        """Clock of the cycle; the caller of `cycle` sleeps on it."""
        return self._clock

    def open(self) -> None:
        """Open the buses and commission all nodes in parallel; block until each was tried once.

        `health` reports a node that does not answer, and further attempts follow until it does. Without buses, an error
        of a device's `open` is raised.
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
        """Stop the drives as fast as they can, and close devices and buses. Safe to call twice."""
        if not self._is_open:
            return
        self._is_open = False
        with self._lock.within(PATIENCE) as is_free:
            if is_free:
                self._modes.halt(self._clock.monotonic())
        if is_free:
            self._settle()
        else:
            self.estop("The HAL ends while its cycle is stuck.")
        if self._caretaker:
            self._caretaker.stop()
        else:
            for device in self._devices:
                device.close()
        for bus in self._buses:
            bus.close()

    def _settle(self) -> None:
        """Cycle until no drive has power, at most for `CLOSING_TIME`."""
        due = self._clock.monotonic()
        for _ in range(round(CLOSING_TIME / self.period)):
            self.cycle()
            if not self._actuators.are_powered:
                return
            due += self.period
            if self._buses:
                self._clock.sleep_until(due)

    def enable(self) -> None:
        """Ask the drives to hold the present position; `mode` becomes `hold` when all drives are enabled.

        Raises:
            CommandRefused: The robot is in fault or stopping, a drive is not ready, its position is unknown, or the
                present position is outside of the limits.
        """
        with self._lock.request():
            if self._modes.mode is Mode.OFF:
                self._start.check(self._clock.monotonic(), self._limiter)
                self._desired = None
                self._limiter.start(self._start.median())
            self._modes.enable(self._clock.monotonic())

    def home(self, device: str) -> None:
        """Ask one device to find its zero, which moves it; the robot's mode is `homing` until then.

        Raises:
            CommandRefused: The robot is not off, or the device is unknown, not ready or has no homing.
        """
        with self._lock.request():
            self._modes.home(find(device, self._actuators.devices), self._clock.monotonic())

    def tare(self, device: str) -> None:
        """Ask one sensor to take its present measurement as zero; its health reports the result.

        Raises:
            CommandRefused: The robot is not off, or the device is unknown or has no tare.
        """
        with self._lock.request():
            self._modes.tare(find(device, self._devices))

    def disable(self) -> None:
        """Disable the drives at once."""
        with self._lock.request():
            self._modes.disable(self._clock.monotonic())

    def stop(self, reason: str) -> None:
        """Take no more commands, perform the stop of the robot file, and disable the drives."""
        with self._lock.request():
            self._stop_reason = reason
            self._modes.stop(self._clock.monotonic())

    def estop(self, reason: str) -> StopResult:
        """Stop every drive as fast as it can, in every mode, and stay in fault until `reset`.

        Several threads may call this at once, also while the cycle is stuck. It blocks until every drive reports that
        it has no power, for about a second at most. This is not a safety-rated emergency stop.

        Args:
            reason: Cause of the fault, for messages.

        Returns:
            Reaction of every drive, and whether all of them stopped.
        """
        text = f"Emergency stop: {reason}"
        self._emergency.latch(text)
        with self._lock.within(self._emergency.LOCK_TIMEOUT):
            self._modes.emergency(text)
            requests = self._emergency.request()
        return self._emergency.watch(requests, lambda: self._number)

    def reset(self) -> None:
        """Leave the fault, here and in the drives, without enabling a drive; no value is called frozen any more.

        Raises:
            CommandRefused: The robot is enabled.
        """
        with self._lock.request():
            self._modes.reset()
            self._emergency.unlatch()
            self._assembler.plausibility.reset()
            for device in self._devices:
                device.reset()

    def command(self, desired: np.ndarray, cycle: int) -> None:
        """Set the desired set-points; they replace earlier ones and expire `command.time_to_live` after their cycle.

        Args:
            desired: Set-points [unit of the commanded signal], shape (n,).
            cycle: Number of the sample from which they were computed.

        Raises:
            CommandRefused: The size is wrong, a value is not finite, the robot is not enabled, the cycle is unknown or
                too old, or a command that answers a later cycle was taken before.
        """
        signal = self.config.command.signal
        desired = checked(desired, signal, self.config.signals[signal].elements)
        with self._lock.request():
            expires = self._watchdog.expiry(cycle, self._clock.monotonic())
            if not self._modes.takes_commands:
                raise CommandRefused(
                    f"The robot is in mode '{self.mode}' and takes commands in 'hold' and 'follow'. "
                    f"{self.fault_text or 'Is it enabled?'}"
                )
            if cycle < self._answered:
                raise CommandRefused(
                    f"The command answers cycle {cycle}, but one that answers cycle {self._answered} came before it. "
                    "Does the network change the order, or do two programs command?"
                )
            self._answered = cycle
            self._desired = (desired, expires)

    def cycle(self) -> tuple[Sample, Applied]:
        """Run one cycle: limits, set-points, SYNC on all buses, answers, sample.

        An error of a driver puts the robot in fault and is raised again.
        """
        try:
            return self._cycle()
        except Exception as error:
            with self._lock.cycle():
                self._modes.fault(f"The cycle failed: {type(error).__name__}: {error}")
            raise

    def _cycle(self) -> tuple[Sample, Applied]:
        for bus in self._buses:
            bus.begin()
        with self._lock.cycle():
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
        self._measured, self._heard = values, self._assembler.heard
        self._start.note(values, start)
        self._incomplete += not complete
        return Sample(self._number, stamp, self.source, complete, values, age, valid), applied

    def _act(self, now: float, stamp: int) -> Applied:
        """Enter the mode of this cycle and send its set-points."""
        modes, limiter = self._modes, self._limiter
        problem = self._cycle_watchdog.problem(now) or self._bus_problem() or limiter.trip(self._heard)
        problem = problem or (self._start.moved(self._heard) if modes.mode is Mode.ENABLING else "")
        problem = problem or self._following.problem(self._heard, now)
        if self._emergency.latched and modes.mode is not Mode.FAULT:
            modes.emergency(self._emergency.latched)
        elif problem and modes.mode is not Mode.OFF and modes.mode is not Mode.FAULT:
            modes.fault(problem)
        desired = self._desired
        if desired is not None and (now > desired[1] or not modes.takes_commands):
            self._desired = desired = None
        modes.step(now, desired is not None, self._park is not None and np.array_equal(limiter.set_point, self._park))
        act = modes.act
        limited = self._move(act, desired)
        sent = limiter.set_point if act in _TRACKED else None
        self._following.note(sent)
        self._assembler.plausibility.command(sent)
        return Applied(
            self._number,
            stamp,
            modes.mode.value,
            self.config.command.signal,
            desired[0] if desired else self._nothing,
            self._nothing if act in (Act.IDLE, Act.DAMP) else limiter.set_point,
            limited,
        )

    def _move(self, act: Act, desired: tuple[np.ndarray, float] | None) -> list[str]:
        """Advance the set-point by one step, send it, and return the limits that acted."""
        limiter, actuators = self._limiter, self._actuators
        limited: list[str] = []
        if act is Act.IDLE:
            actuators.idle()
            return limited
        if act is Act.DAMP:
            limiter.start(self._measured)
            actuators.damp()
            return limited
        if act is Act.START:  # the set-point is the present position, so that no drive jumps
            limiter.start(self._start.median())
        elif act is Act.PARK:
            limited = limiter.step(self._park, self._measured, is_parking=True)
        else:
            limited = limiter.step(desired[0] if desired else None, self._measured)
        actuators.apply(limiter.set_point, lambda: self._modes.is_powered)
        return limited

    def _bus_problem(self) -> str:
        """Return the problem that made a bus unusable; every bus reports it once, so ask all of them in every cycle."""
        troubles = [(bus.name, bus.trouble()) for bus in self._buses]
        return next((f"Bus '{name}' {trouble}" for name, trouble in troubles if trouble), "")

    def health(self) -> dict[str, Any]:
        """Return mode, buses and devices as plain values, for status messages and not for control."""
        return {
            "mode": self.mode,
            "fault": self.fault_text,
            "stop_reason": self._stop_reason,
            "cycles": self._number,
            "incomplete": self._incomplete,
            "limits": self._limiter.blind(self._measured),
            "implausible": self._assembler.plausibility.texts(),
            "doubted": self._assembler.plausibility.count,
            "buses": {bus.name: bus.health() for bus in self._buses},
            "devices": {device.name: device.health().plain() for device in self._devices},
        }


def open_robot(config: RobotConfig, clock: BusClock | None = None) -> Robot:
    """Build the buses and drivers of a robot file; nothing is opened yet.

    Raises:
        ConfigError: A driver or interface is unknown, settings do not fit, or the load of a bus is too high.
    """
    buses, devices = build(config, clock := clock or SystemClock())
    simulated = bool(config.buses) and all(bus.interface in SIMULATED for bus in config.buses.values())
    return Robot(config, devices, buses, clock, "simulated" if simulated else "can")
