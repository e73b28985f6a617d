"""PDOs of a simulated node: what the communication and mapping objects say, and when they may be changed (CiA 301)."""

import struct
from collections.abc import Callable
from dataclasses import dataclass

from simulators.nodes.canopen.objects import Abort, Key, ObjectDictionary, Refused, Value

_INVALID = 1 << 31
_EXTENDED = 1 << 29
_EVENT = (254, 255)
"""These transmission types do not wait for SYNC."""


@dataclass(slots=True)
class Pdo:
    """One PDO that is switched on.

    Attributes:
        cob: Identifier of its frames.
        type: Transmission type: 0 to 240 with SYNC, 254 and 255 by event.
        keys: Objects in the frame, in order.
        layout: Their layout in the frame.
        period: Event timer [s]; 0 if none.
        due: When the event timer next runs out [s].
        syncs: SYNCs since the last frame.
        last: Data last sent or received and not yet applied.
    """

    cob: int
    type: int
    keys: tuple[Key, ...]
    layout: struct.Struct
    period: float = 0.0
    due: float = 0.0
    syncs: int = 0
    last: bytes | None = None

    def pack(self, values: dict[Key, Value]) -> bytes:
        """Return the data of a frame from the object dictionary's values."""
        return self.layout.pack(*[values[key] for key in self.keys])

    def is_due_at_sync(self, values: dict[Key, Value]) -> bytes | None:
        """Return the data to send at this SYNC, or None."""
        if self.type in _EVENT:
            return None
        self.syncs += 1
        if self.syncs < self.type:
            return None
        data = self.pack(values)
        if self.type == 0 and data == self.last:
            return None
        self.syncs = 0
        self.last = data
        return data

    def is_due_at(self, now: float, values: dict[Key, Value]) -> bytes | None:
        """Return the data to send because the event timer has run out, or None."""
        if self.type not in _EVENT or not self.period or now < self.due:
            return None
        self.due = max(self.due + self.period, now)
        return self.pack(values)

    @property
    def is_synchronous(self) -> bool:
        """Whether a received frame waits for SYNC."""
        return self.type not in _EVENT


class PdoTable:
    """All PDOs of a node, kept in step with the objects 1400h to 1BFFh."""

    def __init__(self, objects: ObjectDictionary, changed: Callable[[], None]) -> None:
        """Watch the PDO objects.

        Args:
            objects: The node's object dictionary.
            changed: Called after identifiers may have changed.
        """
        self._objects = objects
        self._changed = changed
        self.receive: list[Pdo] = []
        self.transmit: list[Pdo] = []
        for base in (0x1400, 0x1800):
            for index in self._numbers(base):
                objects.on_write[index] = lambda sub, old, new, index=index: self._check_timing(index, sub, old, new)  # type: ignore[misc]
                objects.on_write[index + 0x200] = lambda sub, old, new, index=index: self._check_mapping(  # type: ignore[misc]
                    index, sub, new
                )
                objects.after_write[index] = lambda sub: self.rebuild()
        self.rebuild()

    def rebuild(self) -> None:
        """Read all PDO objects again."""
        self.receive = [pdo for index in self._numbers(0x1400) if (pdo := self._build(index))]
        self.transmit = [pdo for index in self._numbers(0x1800) if (pdo := self._build(index))]
        self._changed()

    def _numbers(self, base: int) -> list[int]:
        return sorted(index for index, sub in self._objects.entries if base <= index < base + 0x200 and sub == 1)

    def _build(self, index: int) -> Pdo | None:
        values = self._objects.values
        cob = int(values[index, 1])
        keys = self._mapped(index + 0x200)
        if cob & _INVALID or not cob & 0x7FF or not keys or any(key not in values for key in keys):
            return None
        layout = struct.Struct("<" + "".join(self._objects.entries[key].format for key in keys))
        period = int(values.get((index, 5), 0)) * 1e-3
        return Pdo(cob & 0x7FF, int(values.get((index, 2), 255)), keys, layout, period)

    def _mapped(self, index: int) -> tuple[Key, ...]:
        values = self._objects.values
        count = int(values.get((index, 0), 0))
        numbers = [int(values.get((index, sub), 0)) for sub in range(1, count + 1)]
        return tuple((number >> 16, number >> 8 & 0xFF) for number in numbers)

    def _is_valid(self, index: int) -> bool:
        return not int(self._objects.values[index, 1]) & _INVALID

    def _check_timing(self, index: int, sub: int, old: Value, new: Value) -> None:
        old, new = int(old), int(new)
        if sub == 1:
            if not old & _INVALID and not new & _INVALID and (old ^ new) & 0x3FFFFFFF:
                raise Refused(Abort.VALUE)  # the identifier may only change while the PDO is switched off
            if not new & _INVALID and (new & _EXTENDED or not 0x180 < new & 0x7FF < 0x580):
                raise Refused(Abort.VALUE)
        elif sub == 2 and 240 < new < 254:
            raise Refused(Abort.VALUE)
        elif sub == 3 and self._is_valid(index):
            raise Refused(Abort.DEVICE_STATE)

    def _check_mapping(self, index: int, sub: int, new: Value) -> None:
        mapping = index + 0x200
        if self._is_valid(index):
            raise Refused(Abort.DEVICE_STATE)
        if sub:
            if self._objects.values[mapping, 0]:
                raise Refused(Abort.DEVICE_STATE)
            self._check_mapped(int(new), is_received=index < 0x1800)
            return
        bits = [int(self._objects.values[mapping, place]) & 0xFF for place in range(1, int(new) + 1)]
        if not all(bits) or sum(bits) > 64:
            raise Refused(Abort.MAPPING_LENGTH)

    def _check_mapped(self, number: int, is_received: bool) -> None:
        if number == 0:
            return
        entry = self._objects.entry((number >> 16, number >> 8 & 0xFF))
        has_direction = "w" in entry.access if is_received else entry.access != "wo"
        if not entry.mappable or not has_direction:
            raise Refused(Abort.NOT_MAPPABLE)
        if entry.size * 8 != number & 0xFF:
            raise Refused(Abort.MAPPING_LENGTH)
