"""A device on a bus: its place, a slot per quantity, commissioning, silence and identity."""

import logging
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic

import numpy as np
from typing_extensions import TypeVar, override

from hal.calibration.line import Calibration
from hal.config import Positive, Section
from hal.device import UNDER_POWER, Device, DeviceHealth, DeviceState, Reading
from hal.errors import DeviceSilent, HalError, WrongDevice
from hal.protocols.can_frames import Frames
from hal.wire.bus import Bus
from hal.wire.contract import Wire

log = logging.getLogger(__name__)


WireT = TypeVar("WireT", bound=Wire, default=Bus)


class DeviceSettings(Section):
    """Settings of every kind of device."""

    silent_after: Positive = 0.15
    """The device is silent after this time [s] without an answer in a cycle; a silent drive stops the robot."""


@dataclass(frozen=True, slots=True)
class Place(Generic[WireT]):
    """The place of a device on the robot and on its bus.

    Attributes:
        name: Name in the robot file.
        elements: Quantity of the driver -> `signal.element`, for the quantities in the robot file, in the driver's
            order.
        bus: Its CAN bus or serial line.
        node: Its node id.
        folder: Folder of the robot file.
        rate: Cycles per second [Hz].
        calibration: Calibration of the device that belongs here; None without one.
        bounds: Lowest and highest set-point by the robot file's limits [unit of the commanded element]; infinite where
            not given, and for a sensor.
    """

    name: str
    elements: Mapping[str, str]
    bus: WireT
    node: int
    folder: Path
    rate: float
    calibration: Calibration | None = None
    bounds: tuple[float, float] = (-math.inf, math.inf)

    def __str__(self) -> str:
        return f"'{self.name}' (node {self.node} on {self.bus.name})"


class BusDevice(Device, Generic[WireT]):
    """A device that answers once in every cycle. A subclass defines the content of its frames.

    Handlers run in the bus's receive thread and write single slots; the cycle reads them.
    """

    IS_SERIAL: ClassVar[bool] = False
    """Whether it is on a serial line, and not on a CAN bus."""

    Settings: ClassVar[type[DeviceSettings]] = DeviceSettings
    COUNTERS: ClassVar[tuple[str, ...]] = ("malformed", "boots", "emergencies", "commissioned", "failed_openings")

    NEEDS_SYNC: ClassVar[bool] = False
    """Whether SYNC and the HAL's heartbeat must be sent on its bus."""

    @classmethod
    def quantities(cls, settings: Any) -> tuple[str, ...]:
        """Return the quantities that a device with these settings measures, the main quantity first."""
        raise NotImplementedError

    @classmethod
    def commanded(cls, settings: Any) -> str | None:
        """Return the quantity that `apply` sets (`position`, `velocity`, `effort`); None for a sensor."""
        return None

    @classmethod
    def unit_of(cls, settings: Any, quantity: str) -> str | None:
        """Return the unit of a quantity; None if the robot file decides it, as for an analogue input."""
        return None

    @classmethod
    def traffic(cls, settings: Any, rate: float) -> tuple[Frames | tuple[int, float], ...]:
        """Return data bytes and frames per second [Hz] of its whole traffic, at `rate` cycles per second.

        A driver defines this method, or `traffic_of`.
        """
        raise NotImplementedError

    @classmethod
    def traffic_of(
        cls, settings: Any, rate: float, quantities: tuple[str, ...], folder: Path
    ) -> tuple[Frames | tuple[int, float], ...]:
        """Return the `traffic` of a device of which the robot file, in this folder, uses these quantities."""
        return cls.traffic(settings, rate)

    def __init__(self, place: Place[WireT], settings: DeviceSettings) -> None:
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
        self._closing = threading.Lock()
        self._is_closed = True
        place.bus.needs_sync |= self.NEEDS_SYNC
        place.bus.expect(self)

    def _identify(self) -> str:
        """Check the kind of the device and return its `identity`, without changing anything in it."""
        raise NotImplementedError

    def _commission(self) -> None:
        """Make the device safe, configure it, and start its answers to the cycles."""
        raise NotImplementedError

    def _release(self) -> None:
        """Leave the device without power and quiet; it may be silent already."""

    def _fault(self) -> str:
        """Return the fault that the device reports, in a sentence; empty if none."""
        return ""

    def _drives(self) -> bool:
        """Return whether its motor has power by its newest state, independent of faults."""
        return False

    @property
    @override
    def has_power(self) -> bool:
        state = self.health().state
        return state in UNDER_POWER or (state is DeviceState.FAULT and self._drives())

    def _running(self) -> tuple[DeviceState, str]:
        """Return state and sentence of a device that is commissioned, answers, and reports no fault."""
        return DeviceState.READY, ""

    @override
    def open(self) -> None:
        if not self._opening.acquire(blocking=False):  # another thread opens it
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
        self.origin += 1
        self.is_commissioned = True

    def _check_calibration(self) -> None:
        calibration = self._place.calibration
        if calibration is not None and calibration.identity != self.identity:
            raise WrongDevice(
                f"{self._place} is {self.identity or 'a device without an identity'}, its calibration is of "
                f"{calibration.identity}. Was it replaced? Calibrate it again."
            )

    @override
    def read(self) -> Reading:
        return self._reading  # handlers write its arrays

    @override
    def health(self) -> DeviceHealth:
        health = self._health
        if not self.is_commissioned:
            health.state, health.text = self._trouble
        elif self.missed > self._silent_cycles:
            health.state = DeviceState.SILENT
            health.text = f"{self._place} has not answered for {self.missed} cycles. Is it powered, is its cable in?"
        elif self._opening.locked():  # it answers again, but may have lost its configuration
            health.state, health.text = DeviceState.OPENING, "Being commissioned."
        elif fault := self._fault():
            health.state, health.text = DeviceState.FAULT, fault
        else:
            health.state, health.text = self._running()
        return health

    @override
    def close(self) -> None:
        with self._opening:
            with self._closing:  # frames that still come must not set the state to opening
                was_commissioned, self.is_commissioned = self.is_commissioned, False
                self._is_closed, self._trouble = True, (DeviceState.CLOSED, "Closed.")
            if was_commissioned:
                self._release()

    @property
    def is_heard(self) -> bool:
        """Whether it is not silent."""
        return self.missed <= self._silent_cycles

    def _mark_answered(self) -> None:
        """Note that all frames of the device in this cycle have come."""
        self.missed = 0
        self._bus.answered(self)

    def _lose(self, text: str) -> None:
        """Note that the device has lost its configuration."""
        with self._closing:
            self.is_commissioned = False
            if not self._is_closed:
                self._trouble = (DeviceState.OPENING, text)
