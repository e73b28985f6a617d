"""PDOs of a node whose mapping cannot be written, by its data sheet: the ones to use are chosen among those it has."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Literal

import canopen

from hal.commissioning.pdo_map import Pdo, PdoMap, describe
from hal.errors import ConfigError
from hal.protocols import cia301
from hal.protocols.cia301 import Mapped

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
