"""A node's object dictionary: what the EDS file says, and the values that are there now."""

import functools
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path

import canopen
from canopen.objectdictionary import ODVariable

from hal.protocols.eds import is_relative, read_sheet, value_of

Key = tuple[int, int]
"""A key is an index and a sub-index."""
Value = int | float | str

_FORMATS = {1: "?", 2: "b", 3: "h", 4: "i", 5: "B", 6: "H", 7: "I", 8: "f"}
_STRING = 9
STRING_LIMIT = 64
"""A writable string holds this many bytes."""


class Abort(IntEnum):
    """SDO abort codes (CiA 301, table 22) that our nodes send."""

    TOGGLE = 0x0503_0000
    COMMAND = 0x0504_0001
    MEMORY = 0x0504_0005
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    MAPPING_LENGTH = 0x0604_0042
    INCOMPATIBLE = 0x0604_0043
    LENGTH = 0x0607_0010
    TOO_LONG = 0x0607_0012
    TOO_SHORT = 0x0607_0013
    NO_SUBINDEX = 0x0609_0011
    VALUE = 0x0609_0030
    TOO_HIGH = 0x0609_0031
    TOO_LOW = 0x0609_0032
    DEVICE_STATE = 0x0800_0022


class Refused(Exception):
    """An access that the node answers with an abort code."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"0x{code:08X} {code.name}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Entry:
    """Description of one value in the EDS."""

    format: str
    """As in `struct`; empty for a string."""
    access: str
    default: Value
    low: int | None
    high: int | None
    mappable: bool
    is_stated: bool = True
    """Whether the EDS has this default."""

    @property
    def size(self) -> int:
        """Bytes; 0 for a string."""
        return struct.calcsize("<" + self.format)

    def encode(self, value: Value) -> bytes:
        """Return a value as bytes of the bus."""
        return value.encode() if isinstance(value, str) else struct.pack("<" + self.format, value)

    def decode(self, data: bytes) -> Value:
        """Return the value of bytes of the right number.

        Raises:
            Refused: The length does not fit.
        """
        if not self.format:
            if len(data) > STRING_LIMIT:
                raise Refused(Abort.MEMORY)
            return data.decode("ascii", "replace").rstrip("\0")
        if len(data) != self.size:
            raise Refused(Abort.TOO_LONG if len(data) > self.size else Abort.TOO_SHORT)
        value: Value = struct.unpack("<" + self.format, data)[0]
        return value

    def check(self, value: Value) -> None:
        """Refuse a number beyond the limits."""
        if isinstance(value, str):
            return
        if self.high is not None and value > self.high:
            raise Refused(Abort.TOO_HIGH)
        if self.low is not None and value < self.low:
            raise Refused(Abort.TOO_LOW)


def read_eds(path: Path, node: int) -> dict[Key, Entry]:
    """Return every value of an EDS file, with the defaults for this node id."""
    entries = {}
    for key, (entry, relative) in _sheet(path).items():
        entries[key] = replace(entry, default=entry.default + node) if relative else entry  # type: ignore[operator]
    return entries


def as_maker_says(ours: dict[Key, Entry], path: Path, node: int) -> dict[Key, Entry]:
    """Return our node's values with the identity, values and limits of a maker's EDS or DCF file.

    A value that the file does not state, as most do not for 1000h, 1018h and 6502h, stays ours, and so does an object
    with another type in that file, since the node computes with them.
    """
    entries = dict(ours)
    for key, (entry, relative) in _sheet(path, others_too=True).items():
        if key not in ours:
            entries[key] = replace(entry, default=entry.default + node) if relative else entry  # type: ignore[operator]
        elif ours[key].format == entry.format:
            if key[0] == 0x1016:  # some makers limit it to its time, but a node id stands above that
                entry = replace(entry, low=ours[key].low, high=ours[key].high)
            if key == (0x6065, 0) and not entry.default:  # no drive moves within a following error of 0
                entry = replace(entry, is_stated=False)
            stated = entry.default if entry.is_stated else ours[key].default
            entries[key] = replace(entry, default=stated + node if relative else stated)  # type: ignore[operator]
    return entries


@functools.cache
def _sheet(path: Path, others_too: bool = False) -> dict[Key, tuple[Entry, bool]]:
    """Return the values of an EDS or DCF file for node 0, and whether the node id is added to them.

    Args:
        path: The file.
        others_too: Whether objects of types that our nodes do not use are left out rather than refused.
    """
    dictionary = read_sheet(path, 0)
    variables = (v for v in _variables(dictionary) if not others_too or v.data_type in (*_FORMATS, _STRING))
    entries = {(v.index, v.subindex): (_entry(v), is_relative(v)) for v in variables}
    device = dictionary.device_information
    numbers = (device.vendor_number, device.product_number, device.revision_number)
    for sub, number in enumerate(numbers, 1):
        entry, _ = entries.get((0x1018, sub), (None, False))
        if entry is not None and not entry.is_stated and isinstance(number, int):
            entries[0x1018, sub] = replace(entry, default=number, is_stated=True), False
    return entries


def _variables(dictionary: canopen.ObjectDictionary) -> Iterator[ODVariable]:
    for item in dictionary.values():
        if isinstance(item, ODVariable):
            yield item
        else:
            yield from item.subindices.values()


def _entry(variable: ODVariable) -> Entry:
    kind = variable.data_type
    if kind != _STRING and kind not in _FORMATS:
        raise ValueError(f"Object {variable.index:04X}:{variable.subindex} has a data type {kind} that no node uses.")
    empty: Value = "" if kind == _STRING else 0
    value = value_of(variable)
    default = empty if value is None or isinstance(value, bytes) else value
    return Entry(
        format=_FORMATS.get(kind, ""),
        access=variable.access_type,
        default=default,
        low=variable.min,
        high=variable.max,
        mappable=variable.pdo_mappable,
        is_stated=value is not None,
    )


class ObjectDictionary:
    """The values of one node, and what happens when a master writes them.

    The node itself uses `values` directly; `read` and `write` are the master's way and keep the rules.
    """

    def __init__(self, entries: dict[Key, Entry]) -> None:
        self.entries = entries
        self.values: dict[Key, Value] = {}
        self.power_on: dict[Key, Value] = {}
        """What differs from the EDS in this very device: its serial number, its constants."""
        self.on_write: dict[int, Callable[[int, Value, Value], None]] = {}
        """By index: called with sub-index, old and new value before the new one is kept; may raise `Refused`."""
        self.after_write: dict[int, Callable[[int], None]] = {}
        """By index: called with the sub-index after the new value is kept."""
        self.restore()

    def restore(self, first: int = 0, last: int = 0xFFFF) -> None:
        """Set the values of some indices as they are after power-on."""
        for key, entry in self.entries.items():
            if first <= key[0] <= last:
                self.values[key] = self.power_on.get(key, entry.default)

    def entry(self, key: Key) -> Entry:
        """Return the description of a value.

        Raises:
            Refused: The object or sub-index does not exist.
        """
        try:
            return self.entries[key]
        except KeyError:
            known = any(index == key[0] for index, _ in self.entries)
            raise Refused(Abort.NO_SUBINDEX if known else Abort.NO_OBJECT) from None

    def read(self, key: Key) -> bytes:
        """Return a value as a master reads it.

        Raises:
            Refused: It does not exist or cannot be read.
        """
        entry = self.entry(key)
        if entry.access == "wo":
            raise Refused(Abort.WRITE_ONLY)
        return entry.encode(self.values[key])

    def write(self, key: Key, data: bytes) -> None:
        """Write a value as a master does.

        Raises:
            Refused: It does not exist, cannot be written, has another length, or the node does not take it now.
        """
        entry = self.entry(key)
        if entry.access in ("ro", "const"):
            raise Refused(Abort.READ_ONLY)
        self.assign(key, entry.decode(data))

    def assign(self, key: Key, value: Value) -> None:
        """Keep a value that a master has sent, by SDO or PDO, with its consequences.

        Raises:
            Refused: It is out of range, or the node does not take it now.
        """
        self.entries[key].check(value)
        index, sub = key
        if index in self.on_write:
            self.on_write[index](sub, self.values[key], value)
        self.values[key] = value
        if index in self.after_write:
            self.after_write[index](sub)
