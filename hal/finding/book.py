"""Data about the nodes of a bus for the decoding of frames.

A book begins with the data sheets and mappings of the robot file, and learns mappings that an SDO client writes or
reads meanwhile.
"""

from collections.abc import Callable
from dataclasses import dataclass

import canopen
from canopen.objectdictionary import ODVariable

from hal.protocols import cia301, sdo
from hal.protocols.cia301 import MappedObject

Explain = Callable[[bytes], tuple[int | None, str]]
"""An explainer returns node and text of the data of a frame that is not CANopen."""

EXTENDED = 1 << 29
"""This bit marks a 29-bit identifier."""
_PDO_AREAS = ((0x1400, 0x1600, "RPDO"), (0x1800, 0x1A00, "TPDO"))
_PDO_COUNT = 0x200


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame as it was on the bus.

    Attributes:
        stamp: Time stamp of the interface [s since 1970].
        identifier: 11 bits, or 29 if extended; the error class of an error frame.
        data: Up to 8 bytes, of CAN FD up to 64.
        is_extended: Whether the identifier has 29 bits.
        is_remote: Whether the frame requests data.
        is_error: Whether the frame is an error report of the controller.
        is_fd: Whether the frame is one of CAN FD.
    """

    stamp: float
    identifier: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False
    is_fd: bool = False


@dataclass(frozen=True, slots=True)
class NamedPdo:
    """A process data object: label, node and mapped objects."""

    label: str
    node: int
    objects: tuple[MappedObject, ...]


class Book:
    """Data about the nodes of one bus.

    Attributes:
        names: Node id -> name in the robot file.
        dictionaries: Node id -> object dictionary of its data sheet.
        pdos: Identifier -> process data object.
        explainers: Identifier (with bit 29 set if extended) -> kind and explainer of frames that are not CANopen.
    """

    def __init__(self) -> None:
        self.names: dict[int, str] = {}
        self.dictionaries: dict[int, canopen.ObjectDictionary] = {}
        self.pdos: dict[int, NamedPdo] = {}
        self.explainers: dict[int, tuple[str, Explain]] = {}
        self._entries: dict[tuple[int, int, int], int] = {}
        self._requests: dict[int, tuple[int, int, int]] = {}

    def add(self, node: int, name: str, dictionary: canopen.ObjectDictionary) -> None:
        """Add a CANopen node with its data sheet, which defines its first PDO."""
        self.names[node] = name
        self.dictionaries[node] = dictionary
        for parameters, mapping, _ in _PDO_AREAS:
            for number in range(_PDO_COUNT):
                if parameters + number not in dictionary:
                    break
                for index in (parameters + number, mapping + number):
                    for subindex in range(9):
                        self._note_default(node, dictionary, index, subindex)
        self._map(node)

    def explain(self, identifier: int, kind: str, explain: Explain) -> None:
        """Set the explainer of an identifier (with bit 29 set if extended) that is not CANopen."""
        self.explainers[identifier] = (kind, explain)

    def carry(self, node: int, label: str, identifier: int, objects: tuple[MappedObject, ...]) -> None:
        """Replace the mapping of a PDO."""
        for known in [key for key, pdo in self.pdos.items() if (pdo.node, pdo.label) == (node, label)]:
            del self.pdos[known]
        self.pdos[identifier] = NamedPdo(label, node, objects)

    def learn(self, frame: Frame) -> None:
        """Update a mapping that an SDO client writes or reads; ignore all other frames."""
        if frame.is_extended or frame.is_fd or frame.is_remote or frame.is_error or len(frame.data) != 8:
            return
        function, node = frame.identifier & 0x780, frame.identifier & 0x7F
        if function not in (cia301.SDO_REQUEST, cia301.SDO_ANSWER) or not node:
            return
        command, index, subindex = sdo.HEAD.unpack_from(frame.data)
        if not any(0 <= index - base < _PDO_COUNT for area in _PDO_AREAS for base in area[:2]):
            return
        value = int.from_bytes(sdo.expedited(frame.data), "little")
        if function == cia301.SDO_REQUEST:
            self._requests.pop(node, None)
            if command & 0xE2 == 0x22:
                self._requests[node] = (index, subindex, value)
            return
        request = self._requests.pop(node, None)
        if command & 0xE2 == 0x42:
            self._entries[node, index, subindex] = value
        elif command == 0x60 and request is not None and request[:2] == (index, subindex):
            self._entries[node, index, subindex] = request[2]
        else:
            return
        self._map(node)

    def _note_default(self, node: int, dictionary: canopen.ObjectDictionary, index: int, subindex: int) -> None:
        entry: ODVariable | None = dictionary.get_variable(index, subindex)
        if entry is None:
            return
        if entry.relative:  # read without a node id, canopen leaves such a default as `$NODEID+0x180`
            raw: str = entry.default_raw  # type: ignore[attr-defined]
            added = raw.upper().replace("$NODEID", "").strip(" +")
            self._entries[node, index, subindex] = node + int(added or "0", 0)
        elif isinstance(entry.default, int):
            self._entries[node, index, subindex] = entry.default

    def _map(self, node: int) -> None:
        """Set the PDO of a node whose identifier, count and entries are all known."""
        entries = self._entries
        numbers = {index & 0x1FF for known, index, _ in entries if known == node}
        for parameters, mapping, label in _PDO_AREAS:
            for number in numbers:
                identifier = entries.get((node, parameters + number, 1))
                count = entries.get((node, mapping + number, 0), 0)
                parts = [entries.get((node, mapping + number, place)) for place in range(1, count + 1)]
                if identifier is None or not parts or None in parts or identifier & cia301.PDO_INVALID:
                    continue
                objects = tuple(
                    MappedObject(part >> 16, part >> 8 & 0xFF, part & 0xFF) for part in parts if part is not None
                )
                self.carry(node, f"{label}{number + 1}", identifier & 0x7FF, objects)
