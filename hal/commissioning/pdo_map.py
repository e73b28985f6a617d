"""Mapping of objects to PDO: computed, or read from a robot file, and compared with a node's data sheet."""

import functools
import struct
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import canopen
from canopen.objectdictionary import ODVariable
from pydantic import Field

from hal.config import Positive, Section
from hal.errors import ConfigError
from hal.protocols import cia301
from hal.protocols.cia301 import MappedObject


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO.

    Attributes:
        number: 1 to 4.
        objects: MappedObject objects in order; at most 8 bytes together.
        transmission: 1 to 240: with every n-th SYNC; 254, 255: by its event timer.
        event_time: Period of the event timer [s]; 0 without one.
    """

    number: int
    objects: tuple[MappedObject, ...]
    transmission: int = cia301.SYNCHRONOUS
    event_time: float = 0.0

    @property
    def layout(self) -> struct.Struct:
        """Format of the frame; the same instance for the same objects."""
        return _layout(self.objects)

    @property
    def size(self) -> int:
        """Number of data bytes."""
        return sum(item.bits for item in self.objects) // 8

    @property
    def answers_sync(self) -> bool:
        """Whether the PDO is sent with every SYNC, so that a cycle is not complete without it."""
        return self.transmission == cia301.SYNCHRONOUS

    def frame_rate(self, cycle_rate: float) -> float:
        """Return the frames per second at a rate of SYNCs [Hz]."""
        if self.transmission in cia301.EVENT_DRIVEN:
            return 1.0 / self.event_time if self.event_time else 0.0
        return cycle_rate / self.transmission

    def __str__(self) -> str:
        return describe(self.objects)


@dataclass(frozen=True, slots=True)
class PdoMap:
    """All PDOs of a node.

    Attributes:
        receives: RPDOs, which the node receives.
        sends: TPDOs, which the node sends.
        is_fixed: Whether the mapping of the node cannot be written, and must be this one.
    """

    receives: tuple[Pdo, ...] = ()
    sends: tuple[Pdo, ...] = ()
    is_fixed: bool = False

    def frames(self, rate: float) -> tuple[tuple[int, float], ...]:
        """Return (data bytes, frames per second) of each PDO, for the bus budget."""
        return tuple((pdo.size, pdo.frame_rate(rate)) for pdo in (*self.receives, *self.sends))


class PdoEntry(Section):
    """One PDO of a robot file."""

    number: Annotated[int, Field(ge=1, le=cia301.PDO_PER_DIRECTION)]
    objects: Annotated[tuple[str, ...], Field(min_length=1, max_length=64)]
    """Objects with their types, such as `6064h int32` or `2200h:1 uint16`, in the order of the frame."""
    transmission: Annotated[int, Field(ge=1, le=255)] = cia301.SYNCHRONOUS
    """A value of 1 to 240 sends with every n-th SYNC, 254 or 255 by the event timer."""
    event_time: Positive | None = None
    """Period of the event timer [s]."""

    def pdo(self, where: str) -> Pdo:
        """Return the PDO.

        Raises:
            ConfigError: An object is malformed, there are too many bytes, or the transmission is not possible.
        """
        if cia301.LAST_SYNCHRONOUS < self.transmission < cia301.EVENT_DRIVEN[0]:
            raise ConfigError(f"{where}: transmission {self.transmission} is reserved. Use 1 to 240, 254 or 255.")
        if (self.transmission in cia301.EVENT_DRIVEN) != (self.event_time is not None):
            raise ConfigError(f"{where}: event_time belongs to transmission 254 and 255, which need it.")
        objects = []
        for text in self.objects:
            place, _, kind = text.strip().partition(" ")
            try:
                objects.append(cia301.mapped(place, kind.strip()))
            except ValueError as error:
                raise ConfigError(f"{where}: '{text}': {error} Write an object and its type: 6064h int32.") from None
        pdo = Pdo(self.number, tuple(objects), self.transmission, self.event_time or 0.0)
        if pdo.size > cia301.PDO_SIZE:
            raise ConfigError(f"{where}: {pdo} are {pdo.size} bytes, a PDO has {cia301.PDO_SIZE}.")
        return pdo


class PdoSettings(Section):
    """PDO mapping that the robot file defines."""

    sends: tuple[PdoEntry, ...] = ()
    """TPDOs, which the node sends."""
    receives: tuple[PdoEntry, ...] = ()
    """RPDOs, which the node receives."""
    fixed: bool = False
    """Whether the mapping of the node cannot be written, and is only compared."""

    def map(self, label: str) -> PdoMap:
        """Return the PDOs.

        Raises:
            ConfigError: An entry is not possible, or a number is given twice.
        """
        pdos = {}
        for direction in ("receives", "sends"):
            entries: tuple[PdoEntry, ...] = getattr(self, direction)
            numbers = [entry.number for entry in entries]
            if len(set(numbers)) < len(numbers):
                raise ConfigError(f"{label}: pdo.{direction} names a number twice: {', '.join(map(str, numbers))}.")
            pdos[direction] = tuple(entry.pdo(f"{label}: pdo.{direction} {entry.number}") for entry in entries)
        return PdoMap(pdos["receives"], pdos["sends"], self.fixed)


def lay_out(
    objects: Iterable[MappedObject | tuple[MappedObject, ...]],
    first: int = 1,
    transmission: int = cia301.SYNCHRONOUS,
    event_time: float = 0.0,
) -> tuple[Pdo, ...]:
    """Return PDOs for some objects; each object is in the first PDO with space for it.

    Args:
        objects: Objects; an object that is given twice is sent once, those of a tuple are in the same PDO.
        first: Number of the first PDO.
        transmission: Transmission type of all these PDOs.
        event_time: Period of the event timer of all these PDOs [s].
    """
    places: list[list[MappedObject]] = []
    for item in dict.fromkeys(objects):
        together = item if isinstance(item, tuple) else (item,)
        bits = sum(other.bits for other in together)
        room = (place for place in places if sum(other.bits for other in place) + bits <= 8 * cia301.PDO_SIZE)
        place = next(room, None)
        if place is None:
            places.append(place := [])
        place.extend(together)
    return tuple(Pdo(number, tuple(place), transmission, event_time) for number, place in enumerate(places, first))


def check_map(pdos: PdoMap, sheet: canopen.ObjectDictionary, label: str) -> None:
    """Check that the data sheet of a node allows a mapping.

    Raises:
        ConfigError: There are too many PDOs, or an object does not exist, cannot be mapped, or has another length.
    """
    sides = (
        (pdos.receives, "RPDO", "receive", cia301.RPDO_PARAMETERS, "w"),
        (pdos.sends, "TPDO", "send", cia301.TPDO_PARAMETERS, "r"),
    )
    for side, name, verb, parameters, _ in sides:
        for pdo in side:
            if pdo.number > cia301.PDO_PER_DIRECTION or sheet.get_variable(parameters + pdo.number - 1, 1) is None:
                offered = sum(
                    sheet.get_variable(parameters + n, 1) is not None for n in range(cia301.PDO_PER_DIRECTION)
                )
                raise ConfigError(
                    f"{label} would need {name}{pdo.number} to {verb} {pdo}; its data sheet has {offered} of them. "
                    "Use fewer quantities."
                )
    for side, _, verb, _, access in sides:
        for pdo in side:
            for item in pdo.objects:
                _check_object(
                    item, sheet.get_variable(item.index, item.subindex), f"{label} cannot {verb} {item}", access
                )


def _check_object(item: MappedObject, entry: ODVariable | None, what: str, access: str) -> None:
    if entry is None:
        raise ConfigError(f"{what} by PDO: its data sheet has no such object. Is it the right EDS file?")
    if not entry.pdo_mappable:
        raise ConfigError(f"{what} by PDO: its data sheet says that '{entry.name}' cannot be mapped.")
    if access == "w" and "w" not in entry.access_type:
        raise ConfigError(f"{what} by PDO: its data sheet says that '{entry.name}' is read only.")
    if access == "r" and entry.access_type == "wo":
        raise ConfigError(f"{what} by PDO: its data sheet says that '{entry.name}' is write only.")
    if len(entry) != item.bits:
        raise ConfigError(f"{what} as {item.bits} bits: its data sheet gives '{entry.name}' {len(entry)} bits.")


def describe(objects: Sequence[MappedObject]) -> str:
    """Return objects as text: `6041h:0 (16 bit), 6064h:0 (32 bit)`."""
    return ", ".join(f"{item} ({item.bits} bit)" for item in objects) or "nothing"


@functools.lru_cache(maxsize=256)
def _layout(objects: tuple[MappedObject, ...]) -> struct.Struct:
    return struct.Struct("<" + "".join(item.format for item in objects))


_SIGNED, _FLOATS = (2, 3, 4, 0x15), (8, 0x11)
"""These are the data types INTEGER8 to 32 and 64, and REAL32 and 64 (CiA 301, table 44)."""


def is_fixed(sheet: canopen.ObjectDictionary) -> bool:
    """Whether the data sheet does not allow writing any PDO mapping."""
    places = [(base + n, 1) for base in (cia301.RPDO_MAPPING, cia301.TPDO_MAPPING) for n in range(4)]
    entries = [entry for place in places if (entry := sheet.get_variable(*place)) is not None]
    return bool(entries) and not any("w" in entry.access_type for entry in entries)


def chosen_pdos(
    sheet: canopen.ObjectDictionary, required: PdoMap, may_receive: Collection[MappedObject], label: str
) -> PdoMap:
    """Return those PDOs of a node with a fixed mapping that carry the required objects.

    Args:
        sheet: Data sheet of the node.
        required: PDOs with the required objects.
        may_receive: Other objects that may be sent to the node as 0; a PDO with any further object is not used.
        label: Name of the node in error messages.

    Raises:
        ConfigError: The PDOs do not carry all required objects; the message has their objects.
    """
    objects = [item for pdo in required.receives for item in pdo.objects]
    usable = [pdo for pdo in _given(sheet, cia301.RPDO_MAPPING) if {*pdo.objects} <= {*objects, *may_receive}]
    receives = _covering(objects, usable, _given(sheet, cia301.RPDO_MAPPING), f"{label} cannot receive")
    given = _given(sheet, cia301.TPDO_MAPPING)
    sends: tuple[Pdo, ...] = ()
    for pdo in required.sends:
        left = [item for item in pdo.objects if not any(item in other.objects for other in sends)]
        chosen = _covering(left, [other for other in given if other not in sends], given, f"{label} cannot send")
        sends += tuple(replace(other, transmission=pdo.transmission, event_time=pdo.event_time) for other in chosen)
    return PdoMap(receives, sends, is_fixed=True)


def _covering(
    objects: Sequence[MappedObject], usable: Sequence[Pdo], given: Sequence[Pdo], what: str
) -> tuple[Pdo, ...]:
    """Return PDOs that carry all objects, those with most of the objects first."""
    left, chosen = list(objects), []
    while left:
        best = max(usable, key=lambda pdo: sum(item in pdo.objects for item in left), default=None)
        covered = [item for item in left if best is not None and item in best.objects]
        if best is None or not covered:
            has = "; ".join(f"{pdo.number}: {pdo}" for pdo in given) or "none"
            raise ConfigError(f"{what} {describe(left)}: its mapping is fixed by its data sheet. Its PDOs: {has}.")
        chosen.append(best)
        left = [item for item in left if item not in covered]
    return tuple(chosen)


def _given(sheet: canopen.ObjectDictionary, mapping: int) -> list[Pdo]:
    """Return the PDOs of a direction from the defaults of the data sheet, without those that carry single bits."""
    pdos = []
    for number in range(1, cia301.PDO_PER_DIRECTION + 1):
        entries = [_default(sheet, mapping + number - 1, place) for place in range(1, 9)]
        count = _default(sheet, mapping + number - 1, 0)
        objects = tuple(_mapped(sheet, entry) for entry in entries[:count])
        if objects and all(item.bits in (8, 16, 32, 64) for item in objects):
            pdos.append(Pdo(number, objects))
    return pdos


def _default(sheet: canopen.ObjectDictionary, index: int, subindex: int) -> int:
    entry = sheet.get_variable(index, subindex)
    value = getattr(entry, "default", None)
    return value if isinstance(value, int) else 0


def _mapped(sheet: canopen.ObjectDictionary, entry: int) -> MappedObject:
    index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
    kind: Literal["unsigned", "signed", "float"] = "unsigned"
    variable = sheet.get_variable(index, subindex)
    if variable is not None and variable.data_type in _SIGNED:
        kind = "signed"
    elif variable is not None and variable.data_type in _FLOATS:
        kind = "float"
    return MappedObject(index, subindex, bits, kind)
