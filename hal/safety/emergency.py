"""The emergency stop: stop requests to all drives at once, repeated until each has answered."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from hal.clock import Clock
from hal.config import RobotConfig
from hal.device import Device, DeviceState
from hal.wire.contract import Wire
from hal.wire.state import UNUSABLE

log = logging.getLogger(__name__)

TIMEOUT = 1.0
"""The drives must be without power within this time [s]; the longest quick stop needs half of it."""
REQUEST_TIME = 0.05
"""The first requests may take this time [s]; a driver or a bus that blocks longer is not waited for."""
STUCK_PERIODS, STUCK_TIME = 3, 0.03
"""A cycle that did not end for this number of periods and this time [s] is stuck; requests are then repeated here."""
_STOPPED = (DeviceState.READY, DeviceState.FAULT)


@dataclass(frozen=True, slots=True)
class DriveStop:
    """Reaction of one drive to an emergency stop.

    Attributes:
        device: Name of the drive.
        has_stopped: Whether the drive reported after the request that it has no power.
        text: Reaction, and the remedy if it did not stop.
    """

    device: str
    has_stopped: bool
    text: str


@dataclass(frozen=True, slots=True)
class StopResult:
    """Result of an emergency stop.

    Attributes:
        devices: One reaction per drive.
        text: Another problem, as a sentence; empty without one.
    """

    devices: tuple[DriveStop, ...]
    text: str

    @property
    def is_complete(self) -> bool:
        """Whether every drive stopped."""
        return all(device.has_stopped for device in self.devices)


class EmergencyStop:
    """Sender of stop requests, each in its own thread, and monitor of the drives' reactions.

    Attributes:
        latched: Reason to stay in fault; empty without one.
    """

    LOCK_TIMEOUT = 0.02
    """The stop waits at most this time [s] for the running cycle, so that the cycle sends no set-points after it."""

    def __init__(
        self, config: RobotConfig, devices: Sequence[Device], buses: Sequence[Wire], clock: Clock, period: float
    ) -> None:
        self.latched = ""
        self._devices = tuple(devices)
        self._buses = tuple(buses)
        by_name = {bus.name: bus for bus in buses}
        self._bus_of = {name: by_name[entry.bus] for name, entry in config.devices.items() if entry.bus in by_name}
        self._clock, self._period = clock, period

    def latch(self, text: str) -> None:
        """Keep the reason, which the next cycle checks before all else."""
        self.latched = self.latched or text

    def unlatch(self) -> None:
        """Clear the reason, after the fault was reset."""
        self.latched = ""

    def request(self) -> "Requests":
        """Request a stop of every drive, and wait up to `REQUEST_TIME` for the requests to be sent."""
        requests = Requests(self._clock.monotonic())
        for device in self._devices:
            requests.start(device.name, lambda device=device: _stop(device))  # type: ignore[misc]
        requests.join(REQUEST_TIME)
        return requests

    def watch(self, requests: "Requests", cycles: Callable[[], int]) -> StopResult:
        """Wait for the drives' reactions, and repeat the requests if the cycle is stuck.

        Args:
            requests: Result of `request`.
            cycles: Function that returns the number of cycles that have begun.
        """
        begun = turned = now = requests.begun
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
                self._repeat(requests, now)
            self._clock.sleep_until(now + 0.5 * self._period)
            now = self._clock.monotonic()
        stops = tuple(self._reaction(device, after.get(device.name)) for device in self._devices)
        text = "The HAL's cycle is stuck; the drives were stopped without it. Restart the HAL." if is_stuck else ""
        for stop in stops:
            log.log(logging.WARNING if stop.has_stopped else logging.CRITICAL, "'%s' %s", stop.device, stop.text)
        return StopResult(stops, text)

    def _repeat(self, requests: "Requests", now: float) -> None:
        """Repeat, in place of the cycle, the control words and the SYNC that drives answer."""
        for device in self._devices:
            requests.start(device.name, lambda device=device: _stop(device))  # type: ignore[misc]
        for bus in self._buses:
            requests.start(f"bus {bus.name}", lambda bus=bus: bus.sync(now))  # type: ignore[misc]

    def _has_stopped(self, device: Device, since: float) -> bool:
        """Whether the drive reported after `since` [monotonic s] that it has no power."""
        is_fresh = not device.measures or float(device.read().received.max()) > since or not self._buses
        return is_fresh and device.health().state in _STOPPED and not device.has_power

    def _reaction(self, device: Device, after: float | None) -> DriveStop:
        name = device.name
        if after is not None:
            return DriveStop(name, True, f"stopped and without power after {after * 1e3:.0f} ms")
        bus = self._bus_of.get(name)
        if bus is not None and bus.state in UNUSABLE:
            return DriveStop(name, False, f"cannot be reached, bus '{bus.name}' is {bus.state}; cut the power")
        health = device.health()
        if device.has_power:
            power = "under power, in " if health.state is DeviceState.FAULT else ""
            return DriveStop(name, False, f"is still {power}{health.state}; cut the power")
        return DriveStop(name, False, f"did not answer ({health.state}); cut the power")


class Requests:
    """Running requests, at most one per name."""

    def __init__(self, begun: float) -> None:
        self.begun = begun
        self._threads: dict[str, threading.Thread] = {}

    def start(self, name: str, request: Callable[[], None]) -> None:
        """Send a request in a thread, unless the last one of this name still runs."""
        before = self._threads.get(name)
        if before is None or not before.is_alive():
            self._threads[name] = threading.Thread(target=_send, args=(name, request), daemon=True)
            self._threads[name].start()

    def join(self, within: float) -> None:
        """Wait for all requests, together at most `within` [s] of real time."""
        deadline = time.monotonic() + within
        for thread in self._threads.values():
            thread.join(max(deadline - time.monotonic(), 0.0))


def _stop(device: Device) -> None:
    device.quick_stop()
    device.idle()


def _send(name: str, request: Callable[[], None]) -> None:
    try:
        request()
    except Exception:  # the state of the drive shows whether it stopped
        log.exception("The stop request to '%s' failed", name)
