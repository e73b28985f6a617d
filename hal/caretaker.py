"""Opens devices, opens them again when they come back, and runs what they were asked for; enables nothing."""

import logging
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from hal.device import Device, DeviceState
from hal.errors import HalError

log = logging.getLogger(__name__)

PASS_PERIOD = 0.05
"""How often [s] the devices are looked at."""
BACK_OFF = (0.2, 0.4)
"""Pauses [s] between tries to open the same device; the last is repeated."""
NEED_OPENING = (DeviceState.CLOSED, DeviceState.OPENING, DeviceState.SILENT)


class Caretaker:
    """Tries all devices at once, each in its own thread; one that does not answer delays no other."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = tuple(devices)
        self._tries = dict.fromkeys(self._devices, 0)
        self._not_before = dict.fromkeys(self._devices, 0)
        self._seen = dict.fromkeys(self._devices, DeviceState.CLOSED)
        self._running: dict[Device, Future[None]] = {}
        self._errands: set[Device] = set()
        self._passes = 0
        self._stopping = threading.Event()
        self._pool: ThreadPoolExecutor | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Try every device once, then go on looking after them in a thread of its own."""
        self._stopping.clear()
        self._pool = ThreadPoolExecutor(max(len(self._devices), 1), "commission")
        self._look()
        for future in list(self._running.values()):
            future.result()
        self._thread = threading.Thread(target=self._run, name="caretaker", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread, wait for tries that are under way, and close every device."""
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
            self._look()

    def _look(self) -> None:
        self._passes += 1
        for device in self._devices:
            running = self._running.get(device)
            if running is not None:
                if not running.done():
                    continue
                del self._running[device]
                if device not in self._errands:  # one pause to give its first answer in, before it counts as silent
                    self._not_before[device] = self._passes + self._pause(device)
                self._errands.discard(device)
            if device.errand is not None and self._pool:
                self._errands.add(device)
                self._running[device] = self._pool.submit(self._do, device)
                continue
            state = device.health().state
            if state is not self._seen[device]:
                self._seen[device] = state
                if state is not DeviceState.SILENT:  # a node that boots need not wait for its turn
                    self._tries[device], self._not_before[device] = 0, 0
            if state in NEED_OPENING and self._passes >= self._not_before[device] and self._pool:
                self._tries[device] += 1
                self._running[device] = self._pool.submit(self._open, device)

    def _pause(self, device: Device) -> int:
        """Passes between two tries."""
        return round(BACK_OFF[min(self._tries[device], len(BACK_OFF)) - 1] / PASS_PERIOD)

    @staticmethod
    def _do(device: Device) -> None:
        errand, device.errand = device.errand, None
        try:
            if errand is not None:
                errand()
        except Exception:
            log.exception("'%s' cannot do what it was asked for", device.name)

    @staticmethod
    def _open(device: Device) -> None:
        if device.health().state not in NEED_OPENING:
            return  # it came back before its turn
        try:
            device.open()
        except HalError as error:
            log.debug("%s: %s", device.name, error)  # the device's health says it, and the next try comes
        except Exception:  # a driver's mistake must not look like a device that is still being opened
            log.exception("'%s' cannot be opened", device.name)
