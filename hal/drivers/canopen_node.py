"""What every CANopen device has: identity, commissioning, heartbeat, emergencies, and an answer to each SYNC."""

import functools
import logging
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import canopen
import numpy as np
from pydantic import ValidationError

from hal.bus import Bus
from hal.commissioning import Plan, SdoClient, commission, identify, nmt, watch_us
from hal.config import Positive, Section, explain
from hal.device import Device, DeviceHealth, DeviceState, Reading
from hal.errors import ConfigError, DeviceRefused, DeviceSilent, HalError
from hal.protocols import cia301
from hal.protocols.cia301 import NmtCommand, NmtState

log = logging.getLogger(__name__)

START_TIMEOUT = 0.5
"""How long [s] a node may take from NMT start to the heartbeat that says so; five heartbeats."""


class NodeSettings(Section):
    """Settings that every CANopen kind has."""

    eds: Path
    """Electronic data sheet; relative to the folder of the robot file."""
    silent_after: Positive = 0.15
    """How long [s] without answers to SYNC until the device counts as silent; a silent drive stops the robot."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a device is.

    Attributes:
        name: Name in the robot file.
        element: `signal.element` that it serves.
        bus: The bus it is on.
        node: Its node id.
        folder: Folder of the robot file.
        rate: Cycles per second [Hz].
    """

    name: str
    element: str
    bus: Bus
    node: int
    folder: Path
    rate: float

    def __str__(self) -> str:
        return f"'{self.name}' (node {self.node} on {self.bus.name})"


class CanopenNode(Device):
    """A device whose one TPDO answers every SYNC; what it carries is the subclass's business.

    Handlers run in the bus's receive thread and write single slots; the cycle reads them.
    """

    FRAMES: ClassVar[tuple[int, ...]]
    """Data bytes of each frame it takes per cycle, for the bus budget."""
    Settings: ClassVar[type[NodeSettings]] = NodeSettings

    def __init__(self, place: Place, settings: NodeSettings) -> None:
        self.name = place.name
        self.node = place.node
        self.measures = (place.element,)
        self.missed = 1
        self.is_commissioned = False
        self._place = place
        self._bus = place.bus
        self._silent_cycles = max(1, round(settings.silent_after * place.rate))
        self._values = np.full(1, np.nan)
        self._received = np.full(1, -np.inf)
        self._reading = Reading(self._values, self._received)
        self._health = DeviceHealth(
            counters=dict.fromkeys(("malformed", "boots", "emergencies", "commissioned", "failed_openings"), 0)
        )
        self._counters = self._health.counters
        self._trouble: tuple[DeviceState, str] = (DeviceState.CLOSED, "Not opened yet.")
        self._emergency = 0
        self._opening = threading.Lock()
        self._started = threading.Event()
        self._sdo = SdoClient(place.bus, place.node, data_sheet(place.folder / settings.eds), str(place))
        place.bus.subscribe(cia301.TPDO1 + place.node, self._on_tpdo)
        place.bus.subscribe(cia301.HEARTBEAT + place.node, self._on_heartbeat)
        place.bus.subscribe(cia301.EMERGENCY + place.node, self._on_emergency)
        place.bus.expect(self)

    def _plan(self) -> Plan:
        """What the node shall be told."""
        raise NotImplementedError

    def _before_commissioning(self) -> None:
        """Make the node safe to be configured."""

    def _calibrate(self) -> None:
        """Read what the conversion to SI units needs."""

    def _on_tpdo(self, data: bytearray, received: float) -> None:
        raise NotImplementedError

    def _running(self) -> tuple[DeviceState, str]:
        """State and sentence of a node that is commissioned, answers, and reports no emergency."""
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
        plan, place = self._plan(), self._place
        identify(self._sdo, plan, str(place))
        boots = self._counters["boots"]
        self.is_commissioned = False
        self._trouble = (DeviceState.OPENING, "Being commissioned.")
        self._before_commissioning()
        nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)
        commission(self._sdo, plan, self.node)
        self._calibrate()
        self._started.clear()
        nmt(self._bus, NmtCommand.START, self.node)
        if not self._started.wait(START_TIMEOUT):
            raise DeviceRefused(f"{place} does not become operational. Does it send heartbeats?")
        if self._counters["boots"] != boots:
            raise DeviceSilent(f"{place} rebooted while it was being commissioned. Is its supply stable?")
        if not self._counters["commissioned"]:
            self.missed = 1
        self._emergency = 0
        self._counters["commissioned"] += 1
        self.is_commissioned = True

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
        elif self._emergency:
            health.state = DeviceState.FAULT
            health.text = f"{self._place} reports {cia301.describe_emergency(self._emergency)}."
        else:
            health.state, health.text = self._running()
        return health

    def reset(self) -> None:
        """See `Device.reset`; an emergency that persists is reported again by the device."""
        self._emergency = 0

    def close(self) -> None:
        """See `Device.close`; leaves the node pre-operational."""
        with self._opening:
            if not self.is_commissioned:
                return
            self.is_commissioned = False
            self._trouble = (DeviceState.CLOSED, "Closed.")
            try:
                if self._plan().watch_time and self.missed <= self._silent_cycles:
                    watch_us(self._sdo, 0.0)
            except HalError as error:
                log.warning("closing: %s", error)
            nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)

    def _answered(self, value: float, received: float) -> None:
        """A good TPDO has come: the value first, then its time, so that no value looks newer than it is."""
        self._values[0] = value
        self._received[0] = received
        self.missed = 0
        self._bus.answered(self.node)

    def _on_heartbeat(self, data: bytearray, received: float) -> None:
        state = cia301.nmt_state(data)
        if state is None:
            self._counters["malformed"] += 1
        elif state == NmtState.OPERATIONAL:
            self._started.set()
        elif state == NmtState.BOOT_UP:
            self._counters["boots"] += 1
            self._lose(f"{self._place} rebooted and waits to be commissioned.")
        elif self.is_commissioned:
            why = f", after reporting {cia301.describe_emergency(self._emergency)}" if self._emergency else ""
            self._lose(f"{self._place} left the operational state by itself{why}.")

    def _lose(self, text: str) -> None:
        """The node is not as we configured it any more."""
        self.is_commissioned = False
        self._trouble = (DeviceState.OPENING, text)

    def _on_emergency(self, data: bytearray, received: float) -> None:
        found = cia301.emergency(data)
        if found is None:
            self._counters["malformed"] += 1
            return
        self._emergency = found.code
        if found.code:
            self._counters["emergencies"] += 1
            log.warning("%s reports %s", self._place, cia301.describe_emergency(found.code))


@functools.lru_cache(maxsize=32)
def data_sheet(path: Path) -> canopen.ObjectDictionary:
    """Read an EDS file, once per file.

    Raises:
        ConfigError: It is missing or not an EDS file.
    """
    if not path.is_file():
        raise ConfigError(f"There is no EDS file '{path}'. The path is relative to the folder of the robot file.")
    try:
        return canopen.import_od(str(path))
    except Exception as error:  # canopen passes on whatever its parser meets
        raise ConfigError(f"'{path}' is not an EDS file that canopen can read: {error}.") from error


def read_settings(model: type[NodeSettings], settings: dict[str, Any], name: str) -> Any:
    """Check a device's settings.

    Raises:
        ConfigError: An unknown key, or a value that does not fit.
    """
    try:
        return model.model_validate(settings)
    except ValidationError as error:
        raise ConfigError(f"Settings of device '{name}': {explain(error, model)}") from None
