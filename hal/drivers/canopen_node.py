"""What every CANopen device has: identity, commissioning, heartbeat, emergencies, and an answer to each SYNC."""

import functools
import logging
import threading
from pathlib import Path
from typing import ClassVar

import canopen

from hal.commissioning import HEARTBEAT_TIME, Plan, SdoClient, commission, identify, nmt, watch_us
from hal.drivers.can_device import CanDevice, DeviceSettings, Place
from hal.errors import ConfigError, DeviceRefused, HalError
from hal.protocols import cia301
from hal.protocols.cia301 import NmtCommand, NmtState

log = logging.getLogger(__name__)

START_TIMEOUT = 0.5
"""How long [s] a node may take from NMT start to the heartbeat that says so; five heartbeats."""
HEARTBEAT = (1, 1.0 / HEARTBEAT_TIME)
"""What a node's heartbeat adds to the traffic: data bytes, frames per second [Hz]."""
NODES = range(1, 128)


class NodeSettings(DeviceSettings):
    """Settings that every CANopen kind has."""

    eds: Path
    """Electronic data sheet; relative to the folder of the robot file."""


class CanopenNode(CanDevice):
    """A device whose one TPDO answers every SYNC; what it carries is the subclass's business."""

    Settings: ClassVar[type[NodeSettings]] = NodeSettings

    def __init__(self, place: Place, settings: NodeSettings) -> None:
        if place.node not in NODES:
            raise ConfigError(f"Device {place} has a node id that CANopen does not have. It is 1 to 127.")
        super().__init__(place, settings)
        self._emergency = 0
        self._started = threading.Event()
        self._sdo = SdoClient(place.bus, place.node, data_sheet(place.folder / settings.eds), str(place))
        place.bus.needs_sync = True
        place.bus.subscribe(cia301.TPDO1 + place.node, self._on_tpdo)
        place.bus.subscribe(cia301.HEARTBEAT + place.node, self._on_heartbeat)
        place.bus.subscribe(cia301.EMERGENCY + place.node, self._on_emergency)

    def _plan(self) -> Plan:
        """What the node shall be told."""
        raise NotImplementedError

    def _before_commissioning(self) -> None:
        """Make the node safe to be configured."""

    def _calibrate(self) -> None:
        """Read what the conversion to SI units needs."""

    def _on_tpdo(self, data: bytearray, received: float) -> None:
        raise NotImplementedError

    def _identify(self) -> str:
        return identify(self._sdo, self._plan(), str(self._place))

    def _commission(self) -> None:
        self._before_commissioning()
        nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)
        commission(self._sdo, self._plan(), self.node)
        self._calibrate()
        self._started.clear()
        nmt(self._bus, NmtCommand.START, self.node)
        if not self._started.wait(START_TIMEOUT):
            raise DeviceRefused(f"{self._place} does not become operational. Does it send heartbeats?")
        self._emergency = 0

    def _fault(self) -> str:
        if not self._emergency:
            return ""
        return f"{self._place} reports {cia301.describe_emergency(self._emergency)}."

    def reset(self) -> None:
        """See `Device.reset`; an emergency that persists is reported again by the device."""
        self._emergency = 0

    def _release(self) -> None:
        """Leave the node pre-operational, and not looking for our heartbeat."""
        try:
            if self._plan().watch_time and self.is_heard:
                watch_us(self._sdo, 0.0)
        except HalError as error:
            log.warning("closing: %s", error)
        nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)

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
