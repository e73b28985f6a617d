"""A simulated CANopen node (CiA 301): NMT, SDO, PDO, SYNC, heartbeat, EMCY. What it measures or moves is a subclass."""

import struct
from collections.abc import Callable
from enum import IntEnum

from typing_extensions import override

from simulators.nodes.canopen.objects import Abort, ObjectDictionary, Refused, Value, as_maker_says, read_eds
from simulators.nodes.canopen.pdo import Pdo, PdoTable
from simulators.nodes.canopen.sdo import SdoServer
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.node import Frame, Handler, SimulatedNode
from simulators.nodes.plant import Plant

HEARTBEAT_LOST = 0x8130
PDO_TOO_SHORT = 0x8210
HARDWARE = 0x5000
"""These are emergency error codes (CiA 301, table 26)."""

GENERIC, COMMUNICATION = 0x01, 0x10
"""These are bits of the error register."""


class Nmt(IntEnum):
    """NMT states as in a heartbeat."""

    BOOT = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class CanopenNode(SimulatedNode):
    """One node: frames in by `routes` and `sync`, time by `tick`, frames out into `outbox`.

    Times are seconds of one monotonic clock. A node is used by one thread at a time.
    """

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        self.spec = spec
        self.plant = plant
        self._outbox = outbox
        entries = read_eds(spec.eds, spec.node)
        self.objects = ObjectDictionary(as_maker_says(entries, spec.sheet, spec.node) if spec.sheet else entries)
        self.objects.power_on |= {(0x1018, 4): spec.serial, (0x2000, 0): spec.name}
        self.objects.on_write[0x1003] = lambda sub, old, new: self._forget_errors()
        self.objects.on_write[0x1016] = self._check_consumer
        self.objects.after_write[0x1016] = lambda sub: self._watch()
        self.objects.after_write[0x1017] = lambda sub: self._restart_heartbeat()
        self.routes_changed: Callable[[], None] = lambda: None
        self.pdos = PdoTable(self.objects, lambda: self.routes_changed())
        self._sdo = SdoServer(self.objects)
        self.nmt = Nmt.BOOT
        self.is_powered = False
        self.is_muted = False
        """It sends no process data any more, because its sensor is dead; its electronics work."""
        self.is_broken = False
        """It reported a fault of its own since power-on."""
        self._heartbeat_due = 0.0
        self._watched: dict[int, tuple[float, float | None]] = {}
        self._now = 0.0

    @property
    @override
    def condition(self) -> str:
        return self.nmt.name.lower() if self.is_powered else "off"

    def sample(self) -> None:
        """Bring the process values in the object dictionary up to date."""

    def restart(self) -> None:
        """Be as after power-on; the object dictionary already is."""

    def follow(self, now: float) -> None:
        """Act on new process outputs, and on time passing."""

    def may_send(self, pdo: Pdo) -> bool:
        """Whether a PDO may go out on an event."""
        return True

    def connection_lost(self, code: int) -> None:
        """React to a silent master (code 8130h), or to a node taken out of operation (code 0)."""

    def break_down(self) -> None:
        """Report a fault of the device's own."""
        self.is_broken = True
        self.emergency(HARDWARE, GENERIC)

    def power_up(self, now: float) -> None:
        """Start with the values of power-on and send a boot-up message."""
        self._now = now
        self.is_powered = True
        self.is_muted = self.is_broken = False
        self.objects.restore()
        self.restart()
        self._boot()

    def power_down(self) -> None:
        """Fall silent at once."""
        self.is_powered = self.is_broken = False
        self.nmt = Nmt.BOOT
        self.restart()

    def _boot(self) -> None:
        self.nmt = Nmt.BOOT
        self._sdo.reset()
        self._watch()
        self.pdos.rebuild()
        self._send(0x700 + self.spec.node, bytes([Nmt.BOOT]))
        self.nmt = Nmt.PRE_OPERATIONAL
        self._restart_heartbeat()

    def routes(self) -> dict[int, Handler]:
        """Return identifier -> handler of its data, for all identifiers but SYNC."""
        routes: dict[int, Handler] = {0x000: self._on_nmt, 0x600 + self.spec.node: self._on_sdo}
        for node in self._watched:
            routes[0x700 + node] = lambda data, now, node=node: self._on_heartbeat(node, now)  # type: ignore[misc]
        for pdo in self.pdos.receive:
            routes[pdo.cob] = lambda data, now, pdo=pdo: self._on_rpdo(pdo, data, now)  # type: ignore[misc]
        return routes

    def sync(self, now: float) -> None:
        """Handle SYNC: sample and send, then act on the set-points that came before it."""
        if self.nmt is not Nmt.OPERATIONAL or not self.is_powered:
            return
        self._now = now
        self.sample()
        if not self.is_muted:
            for pdo in self.pdos.transmit:
                data = pdo.is_due_at_sync(self.objects.values)
                if data is not None:
                    self._send(pdo.cob, data)
        for pdo in self.pdos.receive:
            if pdo.last is not None and pdo.is_synchronous:
                self._apply(pdo, pdo.last)
                pdo.last = None
        self.follow(now)

    def tick(self, now: float) -> None:
        """Advance heartbeats, event timers and the device itself; called every few milliseconds."""
        if not self.is_powered:
            return
        self._now = now
        for node, (limit, deadline) in list(self._watched.items()):
            if deadline is not None and now > deadline:
                self._watched[node] = (limit, None)
                self._heartbeat_lost()
        self.follow(now)
        period = int(self.objects.values[0x1017, 0]) * 1e-3
        if period and now >= self._heartbeat_due:
            self._heartbeat_due = max(self._heartbeat_due + period, now)
            self._send(0x700 + self.spec.node, bytes([self.nmt]))
        if self.nmt is Nmt.OPERATIONAL and not self.is_muted:
            self._send_events(now)

    def _send_events(self, now: float) -> None:
        if any(pdo.period and not pdo.is_synchronous for pdo in self.pdos.transmit):
            self.sample()
            for pdo in self.pdos.transmit:
                data = pdo.is_due_at(now, self.objects.values) if self.may_send(pdo) else None
                if data is not None:
                    self._send(pdo.cob, data)

    def _send(self, cob: int, data: bytes) -> None:
        if self.is_powered:
            self._outbox.append((cob, data))

    def _on_nmt(self, data: bytes, now: float) -> None:
        if len(data) != 2 or data[1] not in (0, self.spec.node) or not self.is_powered:
            return
        command = data[0]
        if command == 0x81:
            self.power_up(now)
        elif command == 0x82:
            self.objects.restore(0x1000, 0x1FFF)
            self._leave_operational()
            self._boot()
        elif command == 0x01:
            self.nmt = Nmt.OPERATIONAL
        elif command in (0x02, 0x80):
            self._leave_operational()
            self.nmt = Nmt.STOPPED if command == 0x02 else Nmt.PRE_OPERATIONAL

    def _leave_operational(self) -> None:
        if self.nmt is Nmt.OPERATIONAL:
            for pdo in self.pdos.receive:
                pdo.last = None
            self.connection_lost(0)

    def _on_sdo(self, data: bytes, now: float) -> None:
        if not self.is_powered or self.nmt in (Nmt.STOPPED, Nmt.BOOT):
            return
        self._now = now
        self.sample()
        answer = self._sdo.answer(data)
        if answer is not None:
            self._send(0x580 + self.spec.node, answer)

    def _on_rpdo(self, pdo: Pdo, data: bytes, now: float) -> None:
        if self.nmt is not Nmt.OPERATIONAL or not self.is_powered:
            return
        if len(data) < pdo.layout.size:
            self.emergency(PDO_TOO_SHORT, COMMUNICATION)
        elif pdo.is_synchronous:
            pdo.last = data
        else:
            self._now = now
            self._apply(pdo, data)
            self.follow(now)

    def _apply(self, pdo: Pdo, data: bytes) -> None:
        for key, value in zip(pdo.keys, pdo.layout.unpack_from(data), strict=True):
            try:
                self.objects.assign(key, value)
            except Refused:
                continue  # a PDO has no answer: a value out of range is not taken

    def _restart_heartbeat(self) -> None:
        self._heartbeat_due = self._now

    def _check_consumer(self, sub: int, old: Value, new: Value) -> None:
        node = int(new) >> 16 & 0x7F
        others = [int(self.objects.values[0x1016, other]) for other in (1, 2) if other != sub]
        if int(new) & 0xFFFF and node and any(value & 0xFFFF and value >> 16 & 0x7F == node for value in others):
            raise Refused(Abort.INCOMPATIBLE)

    def _watch(self) -> None:
        """Read 1016h; watching begins with the first heartbeat that comes."""
        self._watched = {}
        for sub in (1, 2):
            value = int(self.objects.values[0x1016, sub])
            if value & 0xFFFF and value >> 16 & 0x7F:
                self._watched[value >> 16 & 0x7F] = ((value & 0xFFFF) * 1e-3, None)
        self.routes_changed()

    def _on_heartbeat(self, node: int, now: float) -> None:
        limit, _ = self._watched[node]
        self._watched[node] = (limit, now + limit)

    def _heartbeat_lost(self) -> None:
        self.emergency(HEARTBEAT_LOST, COMMUNICATION)
        behaviour = self.objects.values[0x1029, 1]
        self.connection_lost(HEARTBEAT_LOST)
        if behaviour == 2:
            self.nmt = Nmt.STOPPED
        elif behaviour == 0 and self.nmt is Nmt.OPERATIONAL:
            self.nmt = Nmt.PRE_OPERATIONAL

    def emergency(self, code: int, register: int, info: bytes = b"") -> None:
        """Send EMCY and remember the error (1001h, 1003h)."""
        values = self.objects.values
        values[0x1001, 0] = int(values[0x1001, 0]) | register | GENERIC
        kept = [values[0x1003, sub] for sub in range(1, 8)]
        for sub, value in enumerate([code, *kept], 1):
            values[0x1003, sub] = value
        values[0x1003, 0] = min(int(values[0x1003, 0]) + 1, 8)
        self._send_emergency(code, info)

    def clear_errors(self) -> None:
        """Send that no error is left, if there was one."""
        if self.objects.values[0x1001, 0]:
            self.objects.values[0x1001, 0] = 0
            self._send_emergency(0, b"")

    def _send_emergency(self, code: int, info: bytes) -> None:
        if self.nmt in (Nmt.OPERATIONAL, Nmt.PRE_OPERATIONAL):
            register = int(self.objects.values[0x1001, 0])
            self._send(0x80 + self.spec.node, struct.pack("<HB5s", code, register, info))

    def _forget_errors(self) -> None:
        for sub in range(1, 9):
            self.objects.values[0x1003, sub] = 0
