"""What every CANopen device has: identity, commissioning, heartbeat, emergencies, and PDOs that answer each SYNC."""

import functools
import logging
import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import canopen

from hal.commissioning.node import HEARTBEAT_TIME, Plan, cob_id, commission, identify, inspect_node, nmt, watch_us
from hal.commissioning.pdo_map import Pdo, PdoMap, PdoSettings, check_map, chosen_pdos, describe, is_fixed
from hal.commissioning.sdo_client import SdoClient
from hal.device import Check
from hal.drivers.can_device import CanDevice, DeviceSettings, Place
from hal.errors import ConfigError, DeviceRefused, HalError
from hal.protocols import cia301
from hal.protocols.cia301 import Emergency, Mapped, NmtCommand, NmtState
from hal.wire.bus import Handler

log = logging.getLogger(__name__)

START_TIMEOUT = 0.5
"""How long [s] a node may take from NMT start to the heartbeat that says so; five heartbeats."""
HEARTBEAT = (1, 1.0 / HEARTBEAT_TIME)
"""What a node's heartbeat adds to the traffic: data bytes, frames per second [Hz]."""
BEATS_FORGIVEN = 2.5
"""A node without a heartbeat for so many periods, or `silent_after`, is not believed, whatever else it sends."""
NODES = range(1, 128)

Taker = Callable[[tuple[Any, ...], float], None]
"""Takes the objects of one TPDO, in order, and when they arrived [monotonic s]; called in the receive thread."""

_REPEAT, _LATE, _TWINS = 3, 3, 40
"""A frame too many weighs 3, one that is explained by a late one -3, one as it should be -1; at 40 (times the frames of
a cycle) there are two nodes. So two nodes are told after 20 cycles, and a bus that doubles a quarter of its frames is
not mistaken for them."""
_FORGET = 1 / 16
"""What a late frame explains is forgotten by so much per cycle: whoever answers may run behind for seconds, one SYNC
more now and then, and catch up all at once."""
_BACKLOG = 200
"""So many cycles may be answered all at once, when whoever answers was held up."""
_STRAYS = 3
"""So many PDOs after a boot-up message come from another node: one that booted sends none."""


class NodeSettings(DeviceSettings):
    """Settings that every CANopen kind has."""

    eds: Path
    """Electronic data sheet; relative to the folder of the robot file."""
    pdo: PdoSettings | None = None
    """A PDO layout of your own, in place of the one that follows from the quantities."""


class CanopenNode(CanDevice):
    """A device whose TPDOs answer every SYNC; what they carry is the subclass's business."""

    Settings: ClassVar[type[NodeSettings]] = NodeSettings
    NEEDS_SYNC = True
    COUNTERS = (*CanDevice.COUNTERS, "doubled")
    MAY_RECEIVE: ClassVar[tuple[Mapped, ...]] = ()
    """What a fixed RPDO may carry beside what is wanted, because there is a value for it."""

    def __init__(self, place: Place, settings: NodeSettings, profile: int, pdos: PdoMap) -> None:
        """Prepare a node.

        Args:
            place: Where it is.
            settings: Its settings; their `pdo` takes the place of `pdos`, if it carries the same objects and more.
            profile: Device profile number, the low word of object 1000h.
            pdos: What it shall receive and send.

        Raises:
            ConfigError: A node id, a data sheet or a PDO mapping that cannot be.
        """
        if place.node not in NODES:
            raise ConfigError(f"Device {place} has a node id that CANopen does not have. It is 1 to 127.")
        super().__init__(place, settings)
        sheet = data_sheet(place.folder / settings.eds)
        _check_profile(sheet, profile, f"The data sheet '{settings.eds}' of {place}")
        self._profile = profile
        if settings.pdo is not None:
            pdos = _forced(settings.pdo, pdos, str(place))
        elif is_fixed(sheet):
            pdos = chosen_pdos(sheet, pdos, self.MAY_RECEIVE, str(place))
        self._pdos = pdos
        check_map(self._pdos, sheet, str(place))
        self._sdo = SdoClient(place.bus, place.node, sheet, str(place))
        self._emergency: Emergency | None = None
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
        """What it receives and sends."""
        return self._pdos

    def _taker(self, pdo: Pdo) -> Taker:
        """What takes the objects of one TPDO; asked for once, before anything comes."""
        raise NotImplementedError

    def _writes(self) -> tuple[tuple[Mapped, int], ...]:
        """Objects and values that the node shall be told, beside its PDOs and heartbeats."""
        return ()

    def _watch_time(self) -> float:
        """How long [s] the node shall wait for the HAL's heartbeat before it stops; 0 if it has nothing to stop."""
        return 0.0

    def _before_commissioning(self) -> None:
        """Make the node safe to be configured."""

    def _calibrate(self) -> None:
        """Read what the conversion to SI units needs; comes before `_writes` is asked for."""

    def _plan(self) -> Plan:
        return Plan(self._profile, self._pdos, self._writes(), self._watch_time())

    def _identify(self) -> str:
        return identify(self._sdo, self._profile, str(self._place))

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

    def inspect(self) -> tuple[Check, ...]:
        """See `Device.inspect`."""
        with self._opening:
            return inspect_node(self._sdo, self._plan(), self.node, self.identity)

    def _fault(self) -> str:
        if self._twin:
            return self._twin
        found = self._emergency
        return f"{self._place} reports {_describe(found)}." if found else ""

    def reset(self) -> None:
        """See `Device.reset`; an emergency that persists is reported again by the device."""
        self._emergency, self._twin, self._doubt = None, "", 0.0

    def _release(self) -> None:
        """Leave the node pre-operational, and not looking for our heartbeat."""
        try:
            if self._watch_time() and self.is_heard:
                watch_us(self._sdo, 0.0)
        except HalError as error:
            log.warning("closing: %s", error)
        nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)

    def _keep(self, slot: int, value: float, received: float) -> None:
        """Set one measured value: the value first, then its time, so that no value looks newer than it is."""
        self._values[slot] = value
        self._received[slot] = received

    def _listener(self, pdo: Pdo) -> Handler:
        """What handles the frames of one TPDO; the node has answered a cycle when every cyclic one has come."""
        unpack, size, take, counters = pdo.layout.unpack, pdo.size, self._taker(pdo), self._counters
        mine = self._all & 1 << pdo.number

        def on_tpdo(data: bytearray, received: float) -> None:
            if len(data) != size:
                counters["malformed"] += 1
            elif not self.is_commissioned:
                self._on_stray()
            else:
                take(unpack(data), received)
                if mine:
                    self._on_answer(mine, received)

        return on_tpdo

    def _on_answer(self, mine: int, received: float) -> None:
        missed = self.missed
        if missed != self._since:  # another cycle: what came before does not complete this one
            self._pending, self._since = self._all, missed
        if not missed or not self._pending & mine:
            self._on_double()
        pending = self._pending & ~mine
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
            self._is_answered()

    def _on_double(self) -> None:
        """More than one answer to a SYNC; now and then it was a late one."""
        self._counters["doubled"] += 1
        self._doubt += _REPEAT
        if self._doubt > _TWINS * self._count:
            self._tell_twins("answers each SYNC twice")

    def _on_stray(self) -> None:
        """A PDO of a node that should send none: we have not started it since it booted."""
        self._strays += 1
        if self._strays == _STRAYS:
            self._tell_twins("sent process data on after it had booted")
            self._halt()

    def _is_astray(self) -> bool:
        """Whether it runs though we lost it, and do not count what it sends after a boot-up message either."""
        was_ours = self._counters["commissioned"] > 0 and not self.is_commissioned
        return was_ours and not self._opening.locked() and not 0 <= self._strays < _STRAYS

    def _halt(self) -> None:
        """Take a node out of operation that is not ours to command any more; a drive under power stops by that."""
        nmt(self._bus, NmtCommand.PRE_OPERATIONAL, self.node)

    def _tell_twins(self, what: str) -> None:
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
            why = f", after reporting {_describe(self._emergency)}" if self._emergency else ""
            self._lose(f"{self._place} left the operational state by itself{why}.")
            self._halt()

    def _on_emergency(self, data: bytearray, received: float) -> None:
        found = cia301.emergency(data)
        if found is None:
            self._counters["malformed"] += 1
            return
        before, self._emergency = self._emergency, found if found.code else None
        if found.code:
            self._counters["emergencies"] += 1
            if before != found:
                log.warning("%s reports %s", self._place, _describe(found))


def _describe(found: Emergency) -> str:
    return cia301.describe_emergency(found.code, found.register, found.detail)


def _forced(settings: PdoSettings, wanted: PdoMap, label: str) -> PdoMap:
    """The robot file's layout.

    Raises:
        ConfigError: It does not carry all that is wanted.
    """
    forced = settings.map(label)
    for side, verb in (("receives", "receive"), ("sends", "send")):
        there = {item for pdo in getattr(forced, side) for item in pdo.objects}
        asked = [item for pdo in getattr(wanted, side) for item in pdo.objects]
        missing = [item for item in asked if item not in there]
        if missing:
            has = describe(sorted(there, key=lambda item: item.entry))
            raise ConfigError(f"{label} needs to {verb} {describe(missing)}; its setting `pdo.{side}` has {has}.")
    if not any(pdo.answers_sync for pdo in forced.sends):
        raise ConfigError(f"{label}: of pdo.sends none has transmission 1, so that nothing answers a cycle.")
    return forced


def _check_profile(sheet: canopen.ObjectDictionary, profile: int, what: str) -> None:
    entry = sheet.get_variable(cia301.DEVICE_TYPE, 0)
    found = getattr(entry, "default", None)
    if isinstance(found, int) and found & 0xFFFF and found & 0xFFFF != profile:
        raise ConfigError(f"{what} is of device profile {found & 0xFFFF}, not {profile}. Is it another device's?")


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
