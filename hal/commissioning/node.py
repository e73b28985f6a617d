"""Configuration of a CANopen node, and its verification."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import can

from hal.commissioning.pdo_map import Pdo, PdoMap, describe
from hal.commissioning.sdo_client import SdoClient
from hal.device import Check
from hal.errors import DeviceRefused, WrongDevice
from hal.protocols import cia301
from hal.protocols.cia301 import MappedObject, NmtCommand
from hal.wire.bus import OWN_NODE, PATIENCE, Bus

_COB_ID = 0x7FF
_NO_REQUESTS = 1 << 30
"""This bit in the COB-ID entry of a TPDO excludes remote requests; a node may refuse to clear it."""
_TIMER = 5
"""The event timer [ms] has this sub-index."""


@dataclass(frozen=True, slots=True)
class _Side:
    """One direction: name, first indices of its objects, and first identifier of its frames."""

    name: str
    parameters: int
    mapping: int
    cob_id: int


_RECEIVES = _Side("RPDO", cia301.RPDO_PARAMETERS, cia301.RPDO_MAPPING, cia301.RPDO1)
_SENDS = _Side("TPDO", cia301.TPDO_PARAMETERS, cia301.TPDO_MAPPING, cia301.TPDO1)


def cob_id(first: int, number: int, node: int) -> int:
    """Return the identifier of a PDO by the predefined connection set (CiA 301, 7.3.3); `first` is that of PDO 1."""
    return first + 0x100 * (number - 1) + node


def configure_pdos(sdo: SdoClient, pdos: PdoMap, node: int, label: str) -> None:
    """Configure a node to send and receive these PDOs and no others; a fixed mapping is only compared.

    Raises:
        DeviceSilent: The node stopped answering.
        DeviceRefused: The node refuses the mapping, or its fixed mapping differs; the message has both.
    """
    _silence_others(sdo, pdos, node)
    for side, pdo in _each(pdos):
        if pdos.is_fixed and (entries := _mapped(sdo, side, pdo.number)) != [item.entry for item in pdo.objects]:
            raise DeviceRefused(
                f"{label} has a wrong PDO mapping: {side.name}{pdo.number} carries {_describe(entries)}, and should "
                f"carry {pdo}. Is it the right data sheet, the right `pdo` in the robot file?"
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
    """Read back every PDO of a node; yield whether it is correct, and a sentence.

    Raises:
        DeviceSilent: The node does not answer.
    """
    for side, pdo in _each(pdos):
        where, cob = f"{side.name}{pdo.number}", cob_id(side.cob_id, pdo.number, node)
        index = side.parameters + pdo.number - 1
        try:
            actual, kind = sdo.read(index, 1), sdo.read(index, 2)
            entries = _mapped(sdo, side, pdo.number)
        except DeviceRefused as error:
            yield False, f"{where} cannot be read: {error}"
            continue
        if entries != [item.entry for item in pdo.objects]:
            yield False, f"{where} carries {_describe(entries)}, and should carry {pdo}."
        elif actual & cia301.PDO_INVALID:
            yield False, f"{where} is switched off."
        elif actual & _COB_ID != cob:
            yield False, f"{where} has the identifier {actual & _COB_ID:03X}h, and should have {cob:03X}h."
        elif kind != pdo.transmission:
            yield False, f"{where} has transmission type {kind}, and should have {pdo.transmission}."
        else:
            yield True, f"{where} carries {pdo}."


def _each(pdos: PdoMap) -> Iterator[tuple[_Side, Pdo]]:
    for side, of_side in ((_RECEIVES, pdos.receives), (_SENDS, pdos.sends)):
        for pdo in of_side:
            yield side, pdo


def _mapped(sdo: SdoClient, side: _Side, number: int) -> list[int]:
    """Return the present mapping entries of a node."""
    index = side.mapping + number - 1
    return [sdo.read(index, place) for place in range(1, sdo.read(index, 0) + 1)]


def _describe(entries: list[int]) -> str:
    return describe([MappedObject(entry >> 16, entry >> 8 & 0xFF, entry & 0xFF) for entry in entries])


def _map(sdo: SdoClient, side: _Side, pdo: Pdo, cob: int, is_fixed: bool) -> None:
    """Configure one PDO in the order of CiA 301 (7.5.2.36): off, empty, fill, count, on."""
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
    actual = sdo.read(parameters, 1)
    if actual & (cia301.PDO_INVALID | _COB_ID) != cob & _COB_ID:
        raise DeviceRefused(f"PDO parameter {parameters:04X}h:1 reads back {actual:08X}h after writing {cob:08X}h.")


def _no_requests(sdo: SdoClient, parameters: int) -> int:
    """Return the present bit of the node; 0 if it cannot be read."""
    try:
        return sdo.read(parameters, 1) & _NO_REQUESTS
    except DeviceRefused:
        return 0


def _silence_others(sdo: SdoClient, pdos: PdoMap, node: int) -> None:
    """Switch off all PDOs that are not used."""
    for side, of_side in ((_RECEIVES, pdos.receives), (_SENDS, pdos.sends)):
        used = {pdo.number for pdo in of_side}
        for number in range(1, cia301.PDO_PER_DIRECTION + 1):
            if number not in used and sdo.can_write(side.parameters + number - 1, 1):
                index, cob = side.parameters + number - 1, cob_id(side.cob_id, number, node)
                sdo.write(index, 1, cia301.PDO_INVALID | cob | _no_requests(sdo, index), 4)


HEARTBEAT_TIME = 0.1
"""A node sends its heartbeat with this period [s]."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Configuration of a node.

    Attributes:
        profile: Device profile number, the low word of object 1000h.
        pdos: PDOs that the node sends and receives in the cycle.
        writes: Further objects and their values, written before the node is started.
        watch_time: Time [s] without the HAL's heartbeat after which the node stops; 0 for never.
    """

    profile: int
    pdos: PdoMap
    writes: tuple[tuple[MappedObject, int], ...] = field(default=())
    watch_time: float = 0.0


def nmt(bus: Bus, command: NmtCommand, node: int) -> None:
    """Send an NMT command, which has no answer; the node's heartbeat shows its effect."""
    data = cia301.nmt_command(command, node)
    bus.send(can.Message(arbitration_id=cia301.NMT, is_extended_id=False, data=data), PATIENCE)


def identify(sdo: SdoClient, profile: int, label: str) -> str:
    """Check that the node has the identity of its data sheet; one try, since the node may be absent.

    Returns:
        `canopen:<vendor>-<product>-<serial>` in hexadecimal digits.

    Raises:
        DeviceSilent: The node does not answer.
        WrongDevice: Profile, vendor or product differ.
    """
    device_type = sdo.read(cia301.DEVICE_TYPE, 0, tries=1)
    if device_type & 0xFFFF != profile:
        raise WrongDevice(
            f"{label} has device profile {device_type & 0xFFFF}, not {profile}. Are two node ids swapped?"
        )
    names = []
    for subindex, what in ((1, "vendor"), (2, "product"), (4, "")):  # a file is for all serial numbers, or states any
        if not sdo.has(cia301.IDENTITY, subindex):
            names.append(0)
            continue
        expected = sdo.default(cia301.IDENTITY, subindex)
        actual = sdo.read(cia301.IDENTITY, subindex)
        names.append(actual)
        if what and expected and actual != expected:
            raise WrongDevice(f"{label} has {what} {actual:X}h, its EDS file says {expected:X}h. Is it the right file?")
    return "canopen:" + "-".join(f"{name:08X}" for name in names)


def commission(sdo: SdoClient, plan: Plan, node: int, label: str) -> None:
    """Write and read back PDO, heartbeats and settings of a node that is pre-operational.

    Raises:
        DeviceSilent: The node stopped answering.
        DeviceRefused: The node refuses a value, or its fixed PDO mapping differs.
    """
    configure_pdos(sdo, plan.pdos, node, label)
    sdo.write_checked(cia301.PRODUCER_HEARTBEAT, 0, round(HEARTBEAT_TIME * 1000), 2)
    if plan.watch_time:
        watch_us(sdo, plan.watch_time)
    for item, value in plan.writes:
        sdo.write_checked(item.index, item.subindex, value, item.bits // 8)


def watch_us(sdo: SdoClient, limit: float) -> None:
    """Configure the node to stop after `limit` [s] without the HAL's heartbeat; 0 for never.

    Raises:
        DeviceSilent: The node does not answer.
        DeviceRefused: The node does not support this.
    """
    sdo.write_checked(cia301.CONSUMER_HEARTBEAT, 1, cia301.consumer_heartbeat(OWN_NODE, limit) if limit else 0, 4)


_AGAIN = "Another program configures the node; end it, and let the HAL open the device again."


def inspect_node(sdo: SdoClient, plan: Plan, node: int, identity: str) -> tuple[Check, ...]:
    """Compare a node with its plan.

    Raises:
        DeviceSilent: The node does not answer.
    """
    checks = [_device_type(sdo, plan), Check("identity", bool(identity), identity or "Not read yet: open the device.")]
    for is_good, text in compare_pdos(sdo, plan.pdos, node):
        checks.append(Check("PDO mapping", is_good, text if is_good else f"{text} {_AGAIN}"))
    period = round(HEARTBEAT_TIME * 1000)
    checks.append(
        _value(sdo, "heartbeat", MappedObject(cia301.PRODUCER_HEARTBEAT, 0, 16), period, lambda ms: f"{ms} ms")
    )
    if plan.watch_time:
        watched = cia301.consumer_heartbeat(OWN_NODE, plan.watch_time)
        checks.append(_value(sdo, "watchdog", MappedObject(cia301.CONSUMER_HEARTBEAT, 1, 32), watched, _watchdog))
    for item, value in plan.writes:
        checks.append(_value(sdo, f"object {item}", item, value % (1 << item.bits), str))
    return tuple(checks)


def _device_type(sdo: SdoClient, plan: Plan) -> Check:
    device_type = sdo.read(cia301.DEVICE_TYPE, 0)
    profile = device_type & 0xFFFF
    if profile == plan.profile:
        return Check("device type", True, f"{device_type:08X}h, device profile {profile}.")
    return Check("device type", False, f"Device profile {profile}, not {plan.profile}. Are two node ids swapped?")


def _value(sdo: SdoClient, what: str, item: MappedObject, expected: int, describe: Callable[[int], str]) -> Check:
    """Check that an object still has the value that was written."""
    try:
        actual = sdo.read(item.index, item.subindex)
    except DeviceRefused as error:
        return Check(what, False, f"{error} Is it the right EDS file?")
    if actual == expected:
        return Check(what, True, f"{describe(actual)} ({item}).")
    return Check(what, False, f"{describe(actual)} ({item}), and should be {describe(expected)}. {_AGAIN}")


def _watchdog(entry: int) -> str:
    """Return an entry of 1016h in words."""
    if not entry & 0xFFFF:
        return "expects no heartbeat"
    return f"stops {entry & 0xFFFF} ms after the last heartbeat of node {entry >> 16 & 0x7F}"
