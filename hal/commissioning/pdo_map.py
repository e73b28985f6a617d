"""Which objects travel in which PDO: laid out, read from a robot file, and checked against a node's data sheet."""

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
from hal.protocols.cia301 import Mapped


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO.

    Attributes:
        number: 1 to 4.
        objects: What it carries, in order; at most 8 bytes together.
        transmission: 1 to 240: with every n-th SYNC; 254, 255: by its event timer.
        event_time: Period of the event timer [s]; 0 if it has none.
    """

    number: int
    objects: tuple[Mapped, ...]
    transmission: int = cia301.SYNCHRONOUS
    event_time: float = 0.0

    @property
    def layout(self) -> struct.Struct:
        """How the objects lie in the frame; the same instance for the same objects."""
        return _layout(self.objects)

    @property
    def size(self) -> int:
        """Data bytes."""
        return sum(item.bits for item in self.objects) // 8

    @property
    def answers_sync(self) -> bool:
        """Whether it comes with every SYNC, so that a cycle is not complete without it."""
        return self.transmission == cia301.SYNCHRONOUS

    def frame_rate(self, cycle_rate: float) -> float:
        """Frames per second at so many SYNCs per second [Hz]."""
        if self.transmission in cia301.EVENT_DRIVEN:
            return 1.0 / self.event_time if self.event_time else 0.0
        return cycle_rate / self.transmission

    def __str__(self) -> str:
        return describe(self.objects)


@dataclass(frozen=True, slots=True)
class PdoMap:
    """All PDOs of a node.

    Attributes:
        receives: RPDOs, what the node receives.
        sends: TPDOs, what the node sends.
        is_fixed: The node's mapping cannot be written; it is read and must be this one.
    """

    receives: tuple[Pdo, ...] = ()
    sends: tuple[Pdo, ...] = ()
    is_fixed: bool = False

    def frames(self, rate: float) -> tuple[tuple[int, float], ...]:
        """(Data bytes, frames per second) of each PDO, for the bus budget."""
        return tuple((pdo.size, pdo.frame_rate(rate)) for pdo in (*self.receives, *self.sends))


class PdoEntry(Section):
    """One PDO as a robot file gives it."""

    number: Annotated[int, Field(ge=1, le=cia301.PDO_PER_DIRECTION)]
    objects: Annotated[tuple[str, ...], Field(min_length=1, max_length=64)]
    """Each an object and its type, as `6064h int32` or `2200h:1 uint16`, in the order of the frame."""
    transmission: Annotated[int, Field(ge=1, le=255)] = cia301.SYNCHRONOUS
    """1 to 240: with every n-th SYNC; 254 or 255: by the event timer."""
    event_time: Positive | None = None
    """Period of the event timer [s]."""

    def pdo(self, where: str) -> Pdo:
        """The PDO.

        Raises:
            ConfigError: An object that is none, too many bytes, or a transmission that never happens.
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
    """A layout that the robot file forces."""

    sends: tuple[PdoEntry, ...] = ()
    """TPDOs: what the node sends."""
    receives: tuple[PdoEntry, ...] = ()
    """RPDOs: what the node receives."""
    fixed: bool = False
    """The node's mapping cannot be written: it is read and compared."""

    def map(self, label: str) -> PdoMap:
        """The PDOs.

        Raises:
            ConfigError: An entry that makes no sense, or a number given twice.
        """
        found = {}
        for direction in ("receives", "sends"):
            entries: tuple[PdoEntry, ...] = getattr(self, direction)
            numbers = [entry.number for entry in entries]
            if len(set(numbers)) < len(numbers):
                raise ConfigError(f"{label}: pdo.{direction} names a number twice: {', '.join(map(str, numbers))}.")
            found[direction] = tuple(entry.pdo(f"{label}: pdo.{direction} {entry.number}") for entry in entries)
        return PdoMap(found["receives"], found["sends"], self.fixed)


def lay_out(
    objects: Iterable[Mapped | tuple[Mapped, ...]],
    first: int = 1,
    transmission: int = cia301.SYNCHRONOUS,
    event_time: float = 0.0,
) -> tuple[Pdo, ...]:
    """PDOs that carry some objects: each in the first that has room, so that those named first travel together.

    Args:
        objects: What is to be carried; an object that is named twice is carried once, those of a tuple travel together.
        first: Number of the first PDO.
        transmission: Of all these PDOs.
        event_time: Of all these PDOs [s].
    """
    places: list[list[Mapped]] = []
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
    """Refuse a layout that a node cannot have, by what its data sheet says.

    Raises:
        ConfigError: Too many PDOs, or an object that is not there, not to be mapped, or of another length.
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
                    "Ask for fewer quantities."
                )
    for side, _, verb, _, access in sides:
        for pdo in side:
            for item in pdo.objects:
                _check_object(
                    item, sheet.get_variable(item.index, item.subindex), f"{label} cannot {verb} {item}", access
                )


def _check_object(item: Mapped, entry: ODVariable | None, what: str, access: str) -> None:
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


def describe(objects: Sequence[Mapped]) -> str:
    """Objects in a person's words: `6041h:0 (16 bit), 6064h:0 (32 bit)`."""
    return ", ".join(f"{item} ({item.bits} bit)" for item in objects) or "nothing"


@functools.lru_cache(maxsize=256)
def _layout(objects: tuple[Mapped, ...]) -> struct.Struct:
    return struct.Struct("<" + "".join(item.format for item in objects))


_SIGNED, _FLOATS = (2, 3, 4, 0x15), (8, 0x11)
"""Data types INTEGER8 to 32 and 64, REAL32 and 64 (CiA 301, table 44)."""


def is_fixed(sheet: canopen.ObjectDictionary) -> bool:
    """Whether a data sheet says that no PDO mapping can be written."""
    places = [(base + n, 1) for base in (cia301.RPDO_MAPPING, cia301.TPDO_MAPPING) for n in range(4)]
    found = [entry for place in places if (entry := sheet.get_variable(*place)) is not None]
    return bool(found) and not any("w" in entry.access_type for entry in found)


def chosen_pdos(sheet: canopen.ObjectDictionary, wanted: PdoMap, may_receive: Collection[Mapped], label: str) -> PdoMap:
    """Of the PDOs that a node has, those that carry what is wanted.

    Args:
        sheet: Its data sheet.
        wanted: PDOs with the objects that are wanted.
        may_receive: What else it may be sent; a PDO with anything else is not used, for that would be sent as 0.
        label: Named in what is raised.

    Raises:
        ConfigError: They do not carry all that is wanted; the message has what they carry.
    """
    asked = [item for pdo in wanted.receives for item in pdo.objects]
    usable = [pdo for pdo in _given(sheet, cia301.RPDO_MAPPING) if {*pdo.objects} <= {*asked, *may_receive}]
    receives = _covering(asked, usable, _given(sheet, cia301.RPDO_MAPPING), f"{label} cannot receive")
    there = _given(sheet, cia301.TPDO_MAPPING)
    sends: tuple[Pdo, ...] = ()
    for pdo in wanted.sends:
        left = [item for item in pdo.objects if not any(item in other.objects for other in sends)]
        found = _covering(left, [one for one in there if one not in sends], there, f"{label} cannot send")
        sends += tuple(replace(one, transmission=pdo.transmission, event_time=pdo.event_time) for one in found)
    return PdoMap(receives, sends, is_fixed=True)


def _covering(asked: Sequence[Mapped], usable: Sequence[Pdo], there: Sequence[Pdo], what: str) -> tuple[Pdo, ...]:
    """The fewest PDOs, taking the fullest first, that carry all that is asked for."""
    left, found = list(asked), []
    while left:
        best = max(usable, key=lambda pdo: sum(item in pdo.objects for item in left), default=None)
        covered = [item for item in left if best is not None and item in best.objects]
        if best is None or not covered:
            has = "; ".join(f"{pdo.number}: {pdo}" for pdo in there) or "none"
            raise ConfigError(f"{what} {describe(left)}: its mapping is fixed by its data sheet. Its PDOs: {has}.")
        found.append(best)
        left = [item for item in left if item not in covered]
    return tuple(found)


def _given(sheet: canopen.ObjectDictionary, mapping: int) -> list[Pdo]:
    """The PDOs of a direction by the data sheet's defaults, without those that carry single bits."""
    found = []
    for number in range(1, cia301.PDO_PER_DIRECTION + 1):
        entries = [_default(sheet, mapping + number - 1, place) for place in range(1, 9)]
        count = _default(sheet, mapping + number - 1, 0)
        objects = tuple(_mapped(sheet, entry) for entry in entries[:count])
        if objects and all(item.bits in (8, 16, 32, 64) for item in objects):
            found.append(Pdo(number, objects))
    return found


def _default(sheet: canopen.ObjectDictionary, index: int, subindex: int) -> int:
    entry = sheet.get_variable(index, subindex)
    value = getattr(entry, "default", None)
    return value if isinstance(value, int) else 0


def _mapped(sheet: canopen.ObjectDictionary, entry: int) -> Mapped:
    index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
    kind: Literal["unsigned", "signed", "float"] = "unsigned"
    variable = sheet.get_variable(index, subindex)
    if variable is not None and variable.data_type in _SIGNED:
        kind = "signed"
    elif variable is not None and variable.data_type in _FLOATS:
        kind = "float"
    return Mapped(index, subindex, bits, kind)
