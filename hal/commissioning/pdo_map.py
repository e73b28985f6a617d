"""Which objects travel in which PDO: laid out, read from a robot file, and checked against a node's data sheet.

A driver says which objects it wants; `lay_out` fills PDOs of eight bytes with them in that order. A device whose
mapping cannot be chosen gets its layout from the robot file (`PdoSettings`), and it is then compared, not written.
"""

import functools
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

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
