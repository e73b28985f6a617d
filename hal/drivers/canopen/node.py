"""A CANopen device: identity, commissioning, heartbeat, emergencies, and PDOs that answer each SYNC."""

import functools
import logging
import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import canopen
from typing_extensions import override

from hal.commissioning.node import HEARTBEAT_TIME, Plan, cob_id, commission, identify, inspect_node, nmt, watch_us
from hal.commissioning.pdo_map import Pdo, PdoMap, PdoSettings, check_map, chosen_pdos, describe, is_fixed
from hal.commissioning.sdo_client import SdoClient
from hal.device import Check
from hal.drivers.can_device import CanDevice, DeviceSettings, Place
from hal.errors import ConfigError, DeviceRefused, HalError
from hal.log_limit import LogLimit
from hal.protocols import cia301
from hal.protocols.cia301 import EmergencyMessage, MappedObject, NmtCommand, NmtState
from hal.protocols.eds import read_sheet, value_of
from hal.wire.bus import Handler

log = logging.getLogger(__name__)

START_TIMEOUT = 0.5
"""A node reports that it is operational within this time [s] after NMT start: five heartbeats."""
HEARTBEAT = (1, 1.0 / HEARTBEAT_TIME)
"""A node's heartbeat adds this traffic: data bytes, frames per second [Hz]."""
BEATS_FORGIVEN = 2.5
"""A node without a heartbeat for this number of periods, or for `silent_after`, has failed, even if it sends PDOs."""
NODES = range(1, 128)

PdoHandler = Callable[[tuple[Any, ...], float], None]
"""It takes the objects of one TPDO, in order, and their arrival [monotonic s], in the receive thread."""

_REPEAT, _LATE, _TWINS = 3, 3, 40
"""An extra frame weighs 3, one that a late frame explains -3, an expected one -1; from 40 (times the frames of a cycle)
on there are two nodes. So two nodes are detected after 20 cycles, and a bus that doubles a quarter of its frames is not
mistaken for them."""
_FORGET = 1 / 16
"""The allowance for late frames decreases by this value per cycle: a node may fall behind for seconds, one SYNC at a
time, and then catch up at once."""
_BACKLOG = 200
"""A delayed node may answer this number of cycles at once."""
_STRAYS = 3
"""This number of PDOs after a boot-up message shows a second node, because a booted node sends none."""


class NodeSettings(DeviceSettings):
    """Settings that every CANopen kind has."""

    eds: Path
    """Electronic data sheet; relative to the folder of the robot file."""
    pdo: PdoSettings | None = None
    """A PDO layout that replaces the one derived from the quantities."""


class CanopenNode(CanDevice):
    """A device whose TPDOs answer every SYNC. A subclass defines their content."""

    Settings: ClassVar[type[NodeSettings]] = NodeSettings
    NEEDS_SYNC = True
    COUNTERS = (*CanDevice.COUNTERS, "doubled")
    MAY_RECEIVE: ClassVar[tuple[MappedObject, ...]] = ()
    """Further objects that a fixed RPDO may carry, because the driver has values for them."""

    def __init__(self, place: Place, settings: NodeSettings, profile: int, pdos: PdoMap) -> None:
        """Prepare a node.

        Args:
            place: Its place on the bus.
            settings: Its settings; their `pdo` replaces `pdos` and must carry at least the same objects.
            profile: Device profile number, the low word of object 1000h.
            pdos: PDOs that it must receive and send.

        Raises:
            ConfigError: The node id, the data sheet or the PDO mapping is not valid.
        """
        if place.node not in NODES:
            raise ConfigError(f"Device {place}: a CANopen node id is 1 to 127.")
        super().__init__(place, settings)
        sheet = data_sheet(place.folder / settings.eds)
        _check_profile(sheet, profile, f"The data sheet '{settings.eds}' of {place}")
        self._profile = profile
        if settings.pdo is not None:
            pdos = _own_layout(settings.pdo, pdos, str(place))
        elif is_fixed(sheet):
            pdos = chosen_pdos(sheet, pdos, self.MAY_RECEIVE, str(place))
        self._pdos = pdos
        check_map(self._pdos, sheet, str(place))
        self._sdo = SdoClient(place.bus, place.node, sheet, str(place))
        self._log = LogLimit(log)
        self._emergency: EmergencyMessage | None = None
        self._started = threading.Event()
        self._beat_due = math.inf
        self._beat_patience = max(BEATS_FORGIVEN * HEARTBEAT_TIME, settings.silent_after)
        self._all = sum(1 << pdo.number for pdo in self._pdos.sends if pdo.answers_sync)
        self._count = self._all.bit_count()
        self._pending, self._since = self._all, 0
        self._doubt = 0.0
        self._strays = -math.inf
        self._twin = ""
        for pdo in self._pdos.sends:
            place.bus.subscribe(cob_id(cia301.TPDO1, pdo.number, place.node), self._listener(pdo))
        place.bus.subscribe(cia301.HEARTBEAT + place.node, self._on_heartbeat)
        place.bus.subscribe(cia301.EMERGENCY + place.node, self._on_emergency)

    @property
    def pdos(self) -> PdoMap:
        """PDOs that it receives and sends."""
        return self._pdos

    def _pdo_handler(self, pdo: Pdo) -> PdoHandler:
        """Return the handler of one TPDO; called once, before the first frame."""
        raise NotImplementedError

    def _writes(self) -> tuple[tuple[MappedObject, int], ...]:
        """Return the objects and values to write, besides those of PDOs and heartbeats."""
        return ()

    def _watch_time(self) -> float:
        """Return the time [s] without the HAL's heartbeat after which the node stops; 0 for a sensor."""
        return 0.0

    def _before_commissioning(self) -> None:
        """Make the node safe to be configured."""

    def _calibrate(self) -> None:
        """Read the values for the conversion to SI units; called before `_writes`."""

    def _plan(self) -> Plan:
        return Plan(self._profile, self._pdos, self._writes(), self._watch_time())

    @override
    def _identify(self) -> str:
        return identify(self._sdo, self._profile, str(self._place))

    @override
    def _commission(self) -> None:
        self._before_commissioning()
        nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)
        self._calibrate()
        commission(self._sdo, self._plan(), self.node, str(self._place))
        self._strays, self._doubt, self._pending = -math.inf, 0.0, self._all
        self._started.clear()
        nmt(self._bus, NmtCommand.START, self.node)
        if not self._started.wait(START_TIMEOUT):
            raise DeviceRefused(f"{self._place} does not become operational. Does it send heartbeats?")
        self._emergency = None

    @override
    def inspect(self) -> tuple[Check, ...]:
        with self._opening:
            return inspect_node(self._sdo, self._plan(), self.node, self.identity)

    @override
    def _fault(self) -> str:
        if self._twin:
            return self._twin
        return f"{self._place} reports {_describe(self._emergency)}." if self._emergency else ""

    @override
    def reset(self) -> None:
        self._emergency, self._twin, self._doubt = None, "", 0.0

    @override
    def _release(self) -> None:
        try:
            if self._watch_time() and self.is_heard:
                watch_us(self._sdo, 0.0)
        except HalError as error:
            log.warning("closing: %s", error)
        nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)

    def _keep(self, slot: int, value: float, received: float) -> None:
        """Set one measured value before its time, so that no value looks newer than it is."""
        self._values[slot] = value
        self._received[slot] = received

    def _listener(self, pdo: Pdo) -> Handler:
        """Return the handler of the frames of one TPDO. A node has answered a cycle when all cyclic TPDOs came."""
        unpack, size, take, counters = pdo.layout.unpack, pdo.size, self._pdo_handler(pdo), self._counters
        bit = self._all & 1 << pdo.number

        def on_tpdo(data: bytearray, received: float) -> None:
            if len(data) != size:
                counters["malformed"] += 1
            elif not self.is_commissioned:
                self._on_stray()
            else:
                take(unpack(data), received)
                if bit:
                    self._on_answer(bit, received)

        return on_tpdo

    def _on_answer(self, bit: int, received: float) -> None:
        missed = self.missed
        if missed != self._since:  # another cycle: earlier TPDOs do not complete this one
            self._pending, self._since = self._all, missed
        if not missed or not self._pending & bit:
            self._on_double()
        pending = self._pending & ~bit
        if pending:
            self._pending = pending
            return
        if self._doubt and missed == 1:
            self._doubt += self._count * (-1 if self._doubt > 0 else _FORGET)
        elif missed > 1:
            late = min(missed - 1, _BACKLOG) * self._count
            self._doubt = max(self._doubt - _LATE * late, -_LATE * _BACKLOG)
        self._pending, self._since = self._all, 0
        if received > self._beat_due:
            self._beat_due = math.inf
            self._lose(f"{self._place} goes on sending process data without a heartbeat. Does its firmware hang?")
            self._halt()
        else:
            self._mark_answered()

    def _on_double(self) -> None:
        """Count a second answer to a SYNC, which may be a late one."""
        self._counters["doubled"] += 1
        self._doubt += _REPEAT
        if self._doubt > _TWINS * self._count:
            self._report_twin("answers each SYNC twice")

    def _on_stray(self) -> None:
        """Count a PDO of a node that was not started since it booted and should send none."""
        self._strays += 1
        if self._strays == _STRAYS:
            self._report_twin("sent process data on after it had booted")
            self._halt()

    def _is_astray(self) -> bool:
        """Return whether a lost node is operational, unless its PDOs after a boot-up are still being counted."""
        was_commissioned = self._counters["commissioned"] > 0 and not self.is_commissioned
        return was_commissioned and not self._opening.locked() and not 0 <= self._strays < _STRAYS

    def _halt(self) -> None:
        """Take a node that must not be commanded any more out of operation; this stops a drive under power."""
        nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)

    def _report_twin(self, what: str) -> None:
        if not self._twin:
            self._twin = f"{self._place} {what}. Do two devices have this node id? Give each its own, then reset."
            log.warning("%s", self._twin)

    def _on_heartbeat(self, data: bytearray, received: float) -> None:
        state = cia301.nmt_state(data)
        if state is None:
            self._counters["malformed"] += 1
            return
        self._beat_due = received + self._beat_patience
        if state == NmtState.OPERATIONAL:
            self._started.set()
            if self._is_astray():
                self._halt()
        elif state == NmtState.BOOT_UP:
            self._counters["boots"] += 1
            if self.is_commissioned:
                self._strays = 0
            self._lose(f"{self._place} rebooted and waits to be commissioned.")
        elif self.is_commissioned:
            reason = f", after reporting {_describe(self._emergency)}" if self._emergency else ""
            self._lose(f"{self._place} left the operational state by itself{reason}.")
            self._halt()

    def _on_emergency(self, data: bytearray, received: float) -> None:
        emergency = cia301.emergency(data)
        if emergency is None:
            self._counters["malformed"] += 1
            return
        before, self._emergency = self._emergency, emergency if emergency.code else None
        if emergency.code:
            self._counters["emergencies"] += 1
            if before != emergency:
                self._log.line(logging.WARNING, "", received, f"{self._place} reports {_describe(emergency)}")


def _describe(emergency: EmergencyMessage) -> str:
    return cia301.describe_emergency(emergency.code, emergency.register, emergency.detail)


def _own_layout(settings: PdoSettings, required: PdoMap, label: str) -> PdoMap:
    """Return the layout of the robot file.

    Raises:
        ConfigError: It does not carry all required objects.
    """
    layout = settings.map(label)
    for side, verb in (("receives", "receive"), ("sends", "send")):
        carried = {item for pdo in getattr(layout, side) for item in pdo.objects}
        missing = [item for pdo in getattr(required, side) for item in pdo.objects if item not in carried]
        if missing:
            has = describe(sorted(carried, key=lambda item: item.entry))
            raise ConfigError(f"{label} needs to {verb} {describe(missing)}; its setting `pdo.{side}` has {has}.")
    if not any(pdo.answers_sync for pdo in layout.sends):
        raise ConfigError(f"{label}: no PDO in pdo.sends has transmission 1, so no PDO answers a cycle.")
    return layout


def _check_profile(sheet: canopen.ObjectDictionary, profile: int, what: str) -> None:
    entry = sheet.get_variable(cia301.DEVICE_TYPE, 0)
    device_type = None if entry is None else value_of(entry)
    if isinstance(device_type, int) and device_type & 0xFFFF and device_type & 0xFFFF != profile:
        raise ConfigError(f"{what} has device profile {device_type & 0xFFFF}, not {profile}. Is it another device's?")


@functools.lru_cache(maxsize=32)
def data_sheet(path: Path) -> canopen.ObjectDictionary:
    """Read an EDS file, once per file.

    Raises:
        ConfigError: It is missing or not an EDS file.
    """
    return read_sheet(path)
