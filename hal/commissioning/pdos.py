"""Write a node's PDO mapping and read it back, or compare a mapping that cannot be written."""

from collections.abc import Iterator
from dataclasses import dataclass

from hal.commissioning.pdo_map import Pdo, PdoMap, describe
from hal.commissioning.sdo_client import SdoClient
from hal.errors import DeviceRefused
from hal.protocols import cia301
from hal.protocols.cia301 import Mapped

_COB_ID = 0x7FF
_NO_REQUESTS = 1 << 30
"""Bit of a TPDO's COB-ID entry: it is not sent on request; a node that has it set may refuse to have it cleared."""
_TIMER = 5
"""Sub-index of the event timer [ms]."""


@dataclass(frozen=True, slots=True)
class _Side:
    """One direction: where its objects are and what its frames are called."""

    name: str
    parameters: int
    mapping: int
    cob_id: int


_RECEIVES = _Side("RPDO", cia301.RPDO_PARAMETERS, cia301.RPDO_MAPPING, cia301.RPDO1)
_SENDS = _Side("TPDO", cia301.TPDO_PARAMETERS, cia301.TPDO_MAPPING, cia301.TPDO1)


def cob_id(first: int, number: int, node: int) -> int:
    """Identifier of a PDO by the predefined connection set (CiA 301, 7.3.3), `first` being that of number 1."""
    return first + 0x100 * (number - 1) + node


def configure_pdos(sdo: SdoClient, pdos: PdoMap, node: int, label: str) -> None:
    """Make a node send and receive these PDOs and no others; a fixed mapping is only compared.

    Raises:
        DeviceSilent: The node stopped answering.
        DeviceRefused: It does not take the mapping, or its fixed one is another; the message has both.
    """
    _silence_others(sdo, pdos, node)
    for side, pdo in _each(pdos):
        if pdos.is_fixed and (found := _mapped(sdo, side, pdo.number)) != [item.entry for item in pdo.objects]:
            raise DeviceRefused(
                f"{label} has another PDO mapping than it should: {side.name}{pdo.number} carries {_describe(found)}, "
                f"and should carry {pdo}. Is it the right data sheet, the right `pdo` in the robot file?"
            )
        try:
            _map(sdo, side, pdo, cob_id(side.cob_id, pdo.number, node), pdos.is_fixed)
        except DeviceRefused as error:
            has = _describe(_mapped(sdo, side, pdo.number))
            raise DeviceRefused(
                f"{label} does not take {side.name}{pdo.number} as {pdo}; it has {has}. {error} If its mapping cannot "
                "be changed, give it in the robot file as `pdo` with `fixed: true`."
            ) from error


def compare_pdos(sdo: SdoClient, pdos: PdoMap, node: int) -> Iterator[tuple[bool, str]]:
    """Read every PDO of a node back: whether it is as it should be, and a sentence.

    Raises:
        DeviceSilent: The node does not answer.
    """
    for side, pdo in _each(pdos):
        where, cob = f"{side.name}{pdo.number}", cob_id(side.cob_id, pdo.number, node)
        index = side.parameters + pdo.number - 1
        try:
            found, kind = sdo.read(index, 1), sdo.read(index, 2)
            entries = _mapped(sdo, side, pdo.number)
        except DeviceRefused as error:
            yield False, f"{where} cannot be read: {error}"
            continue
        if entries != [item.entry for item in pdo.objects]:
            yield False, f"{where} carries {_describe(entries)}, and should carry {pdo}."
        elif found & cia301.PDO_INVALID:
            yield False, f"{where} is switched off."
        elif found & _COB_ID != cob:
            yield False, f"{where} has the identifier {found & _COB_ID:03X}h, and should have {cob:03X}h."
        elif kind != pdo.transmission:
            yield False, f"{where} has transmission type {kind}, and should have {pdo.transmission}."
        else:
            yield True, f"{where} carries {pdo}."


def _each(pdos: PdoMap) -> Iterator[tuple[_Side, Pdo]]:
    for side, of_side in ((_RECEIVES, pdos.receives), (_SENDS, pdos.sends)):
        for pdo in of_side:
            yield side, pdo


def _mapped(sdo: SdoClient, side: _Side, number: int) -> list[int]:
    """The mapping entries that a node has now."""
    index = side.mapping + number - 1
    return [sdo.read(index, place) for place in range(1, sdo.read(index, 0) + 1)]


def _describe(entries: list[int]) -> str:
    return describe([Mapped(entry >> 16, entry >> 8 & 0xFF, entry & 0xFF) for entry in entries])


def _map(sdo: SdoClient, side: _Side, pdo: Pdo, cob: int, is_fixed: bool) -> None:
    """Set one PDO up in the order that CiA 301 (7.5.2.36) asks for: off, empty, fill, count, on."""
    parameters, mapping = side.parameters + pdo.number - 1, side.mapping + pdo.number - 1
    cob |= _no_requests(sdo, parameters)
    sdo.write(parameters, 1, cia301.PDO_INVALID | cob, 4)
    sdo.write_checked(parameters, 2, pdo.transmission, 1)
    if pdo.event_time:
        sdo.write_checked(parameters, _TIMER, round(pdo.event_time * 1000), 2)
    if not is_fixed:
        sdo.write(mapping, 0, 0, 1)
        for place, item in enumerate(pdo.objects, 1):
            sdo.write_checked(mapping, place, item.entry, 4)
        sdo.write_checked(mapping, 0, len(pdo.objects), 1)
    sdo.write(parameters, 1, cob, 4)
    found = sdo.read(parameters, 1)
    if found & (cia301.PDO_INVALID | _COB_ID) != cob & _COB_ID:
        raise DeviceRefused(f"PDO parameter {parameters:04X}h:1 reads back {found:08X}h after writing {cob:08X}h.")


def _no_requests(sdo: SdoClient, parameters: int) -> int:
    """The bit as the node has it; not set in one that does not tell."""
    try:
        return sdo.read(parameters, 1) & _NO_REQUESTS
    except DeviceRefused:
        return 0


def _silence_others(sdo: SdoClient, pdos: PdoMap, node: int) -> None:
    """Switch off what would load the bus unasked."""
    for side, of_side in ((_RECEIVES, pdos.receives), (_SENDS, pdos.sends)):
        used = {pdo.number for pdo in of_side}
        for number in range(1, cia301.PDO_PER_DIRECTION + 1):
            if number not in used and sdo.can_write(side.parameters + number - 1, 1):
                index, cob = side.parameters + number - 1, cob_id(side.cob_id, number, node)
                sdo.write(index, 1, cia301.PDO_INVALID | cob | _no_requests(sdo, index), 4)
