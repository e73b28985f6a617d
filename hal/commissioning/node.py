"""Bring a CANopen node into a known configuration, and check that it took it."""

from dataclasses import dataclass, field

import can

from hal.commissioning.pdo_map import PdoMap
from hal.commissioning.pdos import configure_pdos
from hal.commissioning.sdo_client import SdoClient
from hal.errors import WrongDevice
from hal.protocols import cia301
from hal.protocols.cia301 import Mapped, NmtCommand
from hal.wire.bus import OWN_NODE, PATIENCE, Bus

HEARTBEAT_TIME = 0.1
"""Period [s] of a node's heartbeat."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a node shall be told.

    Attributes:
        profile: Device profile number, the low word of object 1000h.
        pdos: What it sends and receives in the cycle.
        writes: Further objects and the values to write to them before the node is started.
        watch_time: How long [s] the node waits for the HAL's heartbeat before it stops; 0 if it does not watch.
    """

    profile: int
    pdos: PdoMap
    writes: tuple[tuple[Mapped, int], ...] = field(default=())
    watch_time: float = 0.0


def nmt(bus: Bus, command: NmtCommand, node: int) -> None:
    """Send an NMT command; nobody answers it, the node's heartbeat tells."""
    data = cia301.nmt_command(command, node)
    bus.send(can.Message(arbitration_id=cia301.NMT, is_extended_id=False, data=data), PATIENCE)


def identify(sdo: SdoClient, profile: int, label: str) -> str:
    """Check that the node is what its data sheet says, and tell it from all others; one try, since nobody may be there.

    Returns:
        `canopen:<vendor>-<product>-<serial>` in hexadecimal digits.

    Raises:
        DeviceSilent: No answer.
        WrongDevice: Another profile, vendor or product.
    """
    device_type = sdo.read(cia301.DEVICE_TYPE, 0, tries=1)
    if device_type & 0xFFFF != profile:
        raise WrongDevice(
            f"{label} has device profile {device_type & 0xFFFF}, not {profile}. Are two node ids swapped?"
        )
    names = []
    for subindex, what in ((1, "vendor"), (2, "product"), (4, "serial number")):
        if not sdo.has(cia301.IDENTITY, subindex):
            names.append(0)
            continue
        expected = sdo.default(cia301.IDENTITY, subindex)
        found = sdo.read(cia301.IDENTITY, subindex)
        names.append(found)
        if expected and found != expected:
            raise WrongDevice(f"{label} has {what} {found:X}h, its EDS file says {expected:X}h. Is it the right file?")
    return "canopen:" + "-".join(f"{name:08X}" for name in names)


def commission(sdo: SdoClient, plan: Plan, node: int, label: str) -> None:
    """Write and read back PDO, heartbeats and settings of a node that is pre-operational.

    Raises:
        DeviceSilent: The node stopped answering.
        DeviceRefused: It does not take a value, or its fixed PDO mapping is another.
    """
    configure_pdos(sdo, plan.pdos, node, label)
    sdo.write_checked(cia301.PRODUCER_HEARTBEAT, 0, round(HEARTBEAT_TIME * 1000), 2)
    if plan.watch_time:
        watch_us(sdo, plan.watch_time)
    for item, value in plan.writes:
        sdo.write_checked(item.index, item.subindex, value, item.bits // 8)


def watch_us(sdo: SdoClient, limit: float) -> None:
    """Have the node stop when the HAL's heartbeat fails for `limit` [s]; 0 to end that.

    Raises:
        DeviceSilent: No answer.
        DeviceRefused: The node cannot.
    """
    sdo.write_checked(cia301.CONSUMER_HEARTBEAT, 1, cia301.consumer_heartbeat(OWN_NODE, limit) if limit else 0, 4)
