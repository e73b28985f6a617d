"""What every device on a bus has: a place, a slot per quantity, commissioning, silence and an identity."""

import logging
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hal.calibration.line import Calibration
from hal.config import Positive, Section
from hal.device import UNDER_POWER, Device, DeviceHealth, DeviceState, Reading
from hal.errors import DeviceSilent, HalError, WrongDevice
from hal.wire.bus import Bus

log = logging.getLogger(__name__)


class DeviceSettings(Section):
    """Settings that every kind has."""

    silent_after: Positive = 0.15
    """How long [s] without its answer in a cycle until the device counts as silent; a silent drive stops the robot."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a device is, and what the robot wants of it.

    Attributes:
        name: Name in the robot file.
        elements: Quantity of the driver -> `signal.element`, for those quantities that the robot file names, in the
            driver's order.
        bus: The bus it is on.
        node: Its node id.
        folder: Folder of the robot file.
        rate: Cycles per second [Hz].
        calibration: What was measured of the device that shall be here; None if nothing was.
        bounds: Lowest and highest set-point by the robot file's limits [unit of the commanded element]; infinite where
            not stated, and for a sensor.
    """

    name: str
    elements: Mapping[str, str]
    bus: Bus
    node: int
    folder: Path
    rate: float
    calibration: Calibration | None = None
    bounds: tuple[float, float] = (-math.inf, math.inf)

    def __str__(self) -> str:
        return f"'{self.name}' (node {self.node} on {self.bus.name})"


class CanDevice(Device):
    """A device that answers once in every cycle; what its frames carry is the subclass's business.

    Handlers run in the bus's receive thread and write single slots; the cycle reads them.
    """

    Settings: ClassVar[type[DeviceSettings]] = DeviceSettings
    COUNTERS: ClassVar[tuple[str, ...]] = ("malformed", "boots", "emergencies", "commissioned", "failed_openings")

    NEEDS_SYNC: ClassVar[bool] = False
    """Whether it waits for the SYNC and the HAL's heartbeat, which are sent on its bus then."""

    @classmethod
    def quantities(cls, settings: Any) -> tuple[str, ...]:
        """What a device with these settings can measure; the quantity it is there for comes first."""
        raise NotImplementedError

    @classmethod
    def commanded(cls, settings: Any) -> str | None:
        """The quantity that `apply` sets (`position`, `velocity`, `effort`); None for a sensor."""
        return None

    @classmethod
    def traffic(cls, settings: Any, rate: float) -> tuple[tuple[int, float] | tuple[int, float, bool], ...]:
        """Data bytes and frames per second [Hz] of all that is sent because of it, at `rate` cycles per second.

        A third value says whether the identifier has 29 bits.
        """
        raise NotImplementedError

    @classmethod
    def traffic_of(
        cls, settings: Any, rate: float, quantities: tuple[str, ...]
    ) -> tuple[tuple[int, float] | tuple[int, float, bool], ...]:
        """`traffic` of a device of which a robot file names only some quantities."""
        return cls.traffic(settings, rate)

    def __init__(self, place: Place, settings: DeviceSettings) -> None:
        self.name = place.name
        self.node = place.node
        self.measures = tuple(place.elements.values())
        quantity = self.commanded(settings)
        self.commands = () if quantity is None else (place.elements[quantity],)
        self.command_quantity = quantity or ""
        self.served = place.elements
        self.missed = 1
        self.patience = 1
        self.is_commissioned = False
        self._place = place
        self._bus = place.bus
        self._silent_cycles = max(1, round(settings.silent_after * place.rate))
        self._slots = {quantity: slot for slot, quantity in enumerate(place.elements)}
        self._values = np.full(len(self.measures), np.nan)
        self._received = np.full(len(self.measures), -np.inf)
        self._reading = Reading(self._values, self._received)
        self._health = DeviceHealth(counters=dict.fromkeys(self.COUNTERS, 0))
        self._counters = self._health.counters
        self._trouble: tuple[DeviceState, str] = (DeviceState.CLOSED, "Not opened yet.")
        self._opening = threading.Lock()
        self._standing_lock = threading.Lock()
        self._is_closed = True
        place.bus.needs_sync |= self.NEEDS_SYNC
        place.bus.expect(self)

    def _identify(self) -> str:
        """Check that the right kind of device is there; its `identity`. Changes nothing in it."""
        raise NotImplementedError

    def _commission(self) -> None:
        """Make the device safe, configure it, and have it answer the cycles."""
        raise NotImplementedError

    def _release(self) -> None:
        """Leave the device without power and quiet; it may be silent by now."""

    def _fault(self) -> str:
        """The fault that the device reports, in a sentence; empty if none."""
        return ""

    def _drives(self) -> bool:
        """Whether its motor has power by what came last, whatever else it reports."""
        return False

    @property
    def has_power(self) -> bool:
        """See `Device.has_power`; a fault that is reported beside the state says nothing of the power."""
        state = self.health().state
        return state in UNDER_POWER or (state is DeviceState.FAULT and self._drives())

    def _running(self) -> tuple[DeviceState, str]:
        """State and sentence of a device that is commissioned, answers, and reports no fault."""
        return DeviceState.READY, ""

    def open(self) -> None:
        """See `Device.open`; a second call while one is under way returns at once."""
        if not self._opening.acquire(blocking=False):
            return
        try:
            self._open()
        except HalError as error:
            self._counters["failed_openings"] += 1
            state = DeviceState.SILENT if isinstance(error, DeviceSilent) else DeviceState.OPENING
            self._trouble = (state, str(error))
            self.is_commissioned = False
            raise
        finally:
            self._opening.release()

    def _open(self) -> None:
        self._is_closed = False
        self.identity = self._identify()
        self._check_calibration()
        boots = self._counters["boots"]
        self.is_commissioned = False
        self._trouble = (DeviceState.OPENING, "Being commissioned.")
        self._commission()
        if self._counters["boots"] != boots:
            raise DeviceSilent(f"{self._place} rebooted while it was being commissioned. Is its supply stable?")
        if not self._counters["commissioned"]:
            self.missed = 1
        self._counters["commissioned"] += 1
        self.is_commissioned = True

    def _check_calibration(self) -> None:
        calibration = self._place.calibration
        if calibration is not None and calibration.identity != self.identity:
            raise WrongDevice(
                f"{self._place} is {self.identity or 'a device that does not tell who it is'}, its calibration is of "
                f"{calibration.identity}. Was it replaced? Calibrate it again."
            )

    def read(self) -> Reading:
        """See `Device.read`; the same two arrays each time, written as frames come."""
        return self._reading

    def health(self) -> DeviceHealth:
        """See `Device.health`; the same record each time."""
        health = self._health
        if not self.is_commissioned:
            health.state, health.text = self._trouble
        elif self.missed > self._silent_cycles:
            health.state = DeviceState.SILENT
            health.text = f"{self._place} has not answered for {self.missed} cycles. Is it powered, is its cable in?"
        elif self._opening.locked():  # it answers again, but what it was told may be forgotten and is being told anew
            health.state, health.text = DeviceState.OPENING, "Being commissioned."
        elif fault := self._fault():
            health.state, health.text = DeviceState.FAULT, fault
        else:
            health.state, health.text = self._running()
        return health

    def close(self) -> None:
        """See `Device.close`."""
        with self._opening:
            with self._standing_lock:  # what still comes from the bus must not look like a device being opened
                was_commissioned, self.is_commissioned = self.is_commissioned, False
                self._is_closed, self._trouble = True, (DeviceState.CLOSED, "Closed.")
            if was_commissioned:
                self._release()

    @property
    def is_heard(self) -> bool:
        """Whether it answered lately enough not to count as silent."""
        return self.missed <= self._silent_cycles

    def _is_answered(self) -> None:
        """All that the device sends in a cycle has come."""
        self.missed = 0
        self._bus.answered(self)

    def _lose(self, text: str) -> None:
        """The device is not as we configured it any more."""
        with self._standing_lock:
            self.is_commissioned = False
            if not self._is_closed:
                self._trouble = (DeviceState.OPENING, text)
