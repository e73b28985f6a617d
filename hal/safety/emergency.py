"""The emergency stop: every drive is asked at once and until it has answered, whatever else is stuck."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from hal.clock import Clock
from hal.config import RobotConfig
from hal.device import Device, DeviceState
from hal.wire.bus import Bus
from hal.wire.state import UNUSABLE

log = logging.getLogger(__name__)

TIMEOUT = 1.0
"""How long [s] the drives may take to be without power; the longest quick stop is half of it."""
ASKING_TIME = 0.05
"""How long [s] the first asking may take; a driver or a bus that blocks is not waited for."""
STUCK_PERIODS, STUCK_TIME = 3, 0.03
"""A cycle that did not end for so many periods and for so long [s] is stuck; the drives are then asked from here."""
_STOPPED = (DeviceState.READY, DeviceState.FAULT)


@dataclass(frozen=True, slots=True)
class Stopped:
    """What one drive did about an emergency stop.

    Attributes:
        device: Its name.
        has_stopped: Whether it said itself, after it was asked, that it is without power.
        text: What it did; what to do if it did not stop.
    """

    device: str
    has_stopped: bool
    text: str


@dataclass(frozen=True, slots=True)
class Emergency:
    """What came of an emergency stop.

    Attributes:
        devices: One answer per drive.
        text: What else is wrong, in a sentence; empty if nothing is.
    """

    devices: tuple[Stopped, ...]
    text: str

    @property
    def is_complete(self) -> bool:
        """Whether every drive stopped."""
        return all(one.has_stopped for one in self.devices)


class EmergencyStop:
    """Asks the drives to stop, repeats it, and looks who did. Each is asked by a thread of its own.

    Attributes:
        latched: Why the robot must stay in fault; empty if it need not.
    """

    LOCK_TIMEOUT = 0.02
    """How long [s] to wait for the cycle in progress, so that it does not send set-points meanwhile."""

    def __init__(
        self, config: RobotConfig, devices: Sequence[Device], buses: Sequence[Bus], clock: Clock, period: float
    ) -> None:
        self.latched = ""
        self._devices = tuple(devices)
        self._buses = tuple(buses)
        by_name = {bus.name: bus for bus in buses}
        self._bus_of = {name: by_name[entry.bus] for name, entry in config.devices.items() if entry.bus in by_name}
        self._clock, self._period = clock, period

    def latch(self, text: str) -> None:
        """The cycle, should it ever turn again, finds this first."""
        self.latched = self.latched or text

    def unlatch(self) -> None:
        """The fault was reset."""
        self.latched = ""

    def ask(self) -> "Asked":
        """Ask every drive, and wait a moment for those who asked to come back."""
        asked = Asked(self._clock.monotonic())
        for device in self._devices:
            asked.start(device.name, lambda device=device: _ask(device))  # type: ignore[misc]
        asked.join(ASKING_TIME)
        return asked

    def watch(self, asked: "Asked", cycles: Callable[[], int]) -> Emergency:
        """Wait for the drives' answers, and ask again if the cycle does not.

        Args:
            asked: What `ask` returned.
            cycles: How many cycles have begun.
        """
        begun = turned = now = asked.begun
        seen, is_stuck = cycles(), False
        after: dict[str, float] = {}
        while now <= begun + TIMEOUT:
            for device in self._devices:
                if device.name not in after and self._has_stopped(device, begun):
                    after[device.name] = now - begun
            if len(after) == len(self._devices):
                break
            if cycles() != seen:
                seen, turned = cycles(), now
            elif now - turned > max(STUCK_PERIODS * self._period, STUCK_TIME):
                is_stuck = True
                self._ask_again(asked, now)
            self._clock.sleep_until(now + 0.5 * self._period)
            now = self._clock.monotonic()
        found = tuple(self._tell(device, after.get(device.name)) for device in self._devices)
        text = "The HAL's cycle is stuck; the drives were asked without it. Restart the HAL." if is_stuck else ""
        for one in found:
            log.log(logging.WARNING if one.has_stopped else logging.CRITICAL, "'%s' %s", one.device, one.text)
        return Emergency(found, text)

    def _ask_again(self, asked: "Asked", now: float) -> None:
        """What the cycle would do: repeat the control words, and the SYNC that drives answer."""
        for device in self._devices:
            asked.start(device.name, lambda device=device: _ask(device))  # type: ignore[misc]
        for bus in self._buses:
            asked.start(f"bus {bus.name}", lambda bus=bus: bus.sync(now))  # type: ignore[misc]

    def _has_stopped(self, device: Device, since: float) -> bool:
        """Whether the drive said after `since` [monotonic s] that it is without power."""
        is_fresh = not device.measures or float(device.read().received.max()) > since or not self._buses
        return is_fresh and device.health().state in _STOPPED and not device.has_power

    def _tell(self, device: Device, after: float | None) -> Stopped:
        name = device.name
        if after is not None:
            return Stopped(name, True, f"stopped and without power after {after * 1e3:.0f} ms")
        bus = self._bus_of.get(name)
        if bus is not None and bus.state in UNUSABLE:
            return Stopped(name, False, f"cannot be reached, bus '{bus.name}' is {bus.state}; cut the power")
        health = device.health()
        if device.has_power:
            power = "under power, in " if health.state is DeviceState.FAULT else ""
            return Stopped(name, False, f"is still {power}{health.state}; cut the power")
        return Stopped(name, False, f"did not answer ({health.state}); cut the power")


class Asked:
    """Who was asked when; one question at a time per name."""

    def __init__(self, begun: float) -> None:
        self.begun = begun
        self._threads: dict[str, threading.Thread] = {}

    def start(self, name: str, question: Callable[[], None]) -> None:
        """Ask in a thread, unless the one before has not come back."""
        before = self._threads.get(name)
        if before is None or not before.is_alive():
            self._threads[name] = threading.Thread(target=_carefully, args=(name, question), daemon=True)
            self._threads[name].start()

    def join(self, within: float) -> None:
        """Wait for all, together no longer than `within` [s] of real time."""
        deadline = time.monotonic() + within
        for thread in self._threads.values():
            thread.join(max(deadline - time.monotonic(), 0.0))


def _ask(device: Device) -> None:
    device.quick_stop()
    device.idle()


def _carefully(name: str, question: Callable[[], None]) -> None:
    try:
        question()
    except Exception:  # whatever it is, the drive shows by its state whether it stopped
        log.exception("'%s' could not be asked to stop", name)
