"""Thread that opens devices, opens them again when they return, and runs their long requests. It enables no device."""

import logging
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from hal.device import Device, DeviceState
from hal.errors import HalError

log = logging.getLogger(__name__)

PASS_PERIOD = 0.05
"""The devices are checked with this period [s]."""
BACK_OFF = (0.2, 0.4)
"""Attempts to open the same device have these pauses [s] between them; the last pause is repeated."""
NEED_OPENING = (DeviceState.CLOSED, DeviceState.OPENING, DeviceState.SILENT)


class Caretaker:
    """Opener of all devices, each in its own thread: a device that does not answer delays no other."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = tuple(devices)
        self._tries = dict.fromkeys(self._devices, 0)
        self._not_before = dict.fromkeys(self._devices, 0)
        self._seen = dict.fromkeys(self._devices, DeviceState.CLOSED)
        self._running: dict[Device, Future[None]] = {}
        self._with_request: set[Device] = set()
        self._passes = 0
        self._stopping = threading.Event()
        self._pool: ThreadPoolExecutor | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Try to open every device once, then continue in a separate thread."""
        self._stopping.clear()
        self._pool = ThreadPoolExecutor(max(len(self._devices), 1), "commission")
        self._check()
        for future in list(self._running.values()):
            future.result()
        self._thread = threading.Thread(target=self._run, name="caretaker", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread, wait for running attempts, and close every device."""
        self._stopping.set()
        if self._thread:
            self._thread.join()
        if self._pool:
            for closing in [self._pool.submit(device.close) for device in self._devices]:
                closing.result()
            self._pool.shutdown()
        self._thread = self._pool = None

    def _run(self) -> None:
        while not self._stopping.wait(PASS_PERIOD):
            self._check()

    def _check(self) -> None:
        self._passes += 1
        for device in self._devices:
            running = self._running.get(device)
            if running is not None:
                if not running.done():
                    continue
                del self._running[device]
                if device not in self._with_request:  # a pause for its first answer, before it counts as silent
                    self._not_before[device] = self._passes + self._pause(device)
                self._with_request.discard(device)
            if device.long_request is not None and self._pool:
                self._with_request.add(device)
                self._running[device] = self._pool.submit(self._execute, device)
                continue
            state = device.health().state
            if state is not self._seen[device]:
                self._seen[device] = state
                if state is not DeviceState.SILENT:  # a node that boots is opened without a pause
                    self._tries[device], self._not_before[device] = 0, 0
            if state in NEED_OPENING and self._passes >= self._not_before[device] and self._pool:
                self._tries[device] += 1
                self._running[device] = self._pool.submit(self._open, device)

    def _pause(self, device: Device) -> int:
        """Return the number of passes between two attempts."""
        return round(BACK_OFF[min(self._tries[device], len(BACK_OFF)) - 1] / PASS_PERIOD)

    @staticmethod
    def _execute(device: Device) -> None:
        request, device.long_request = device.long_request, None
        try:
            if request is not None:
                request()
        except Exception:
            log.exception("A request to '%s' failed", device.name)

    @staticmethod
    def _open(device: Device) -> None:
        if device.health().state not in NEED_OPENING:
            return  # the device returned before this attempt
        try:
            device.open()
        except HalError as error:
            log.debug("%s: %s", device.name, error)  # the device's health reports it, and the next attempt follows
        except Exception:  # an error of a driver must not look like a device that is still opening
            log.exception("'%s' cannot be opened", device.name)
