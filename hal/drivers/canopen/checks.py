"""What a person wants to know of a CANopen node that is there: read back, each with what to do."""

from collections.abc import Callable

from hal.commissioning.node import HEARTBEAT_TIME, Plan
from hal.commissioning.pdos import compare_pdos
from hal.commissioning.sdo_client import SdoClient
from hal.device import Check
from hal.errors import DeviceRefused
from hal.protocols import cia301
from hal.protocols.cia301 import Mapped
from hal.wire.bus import OWN_NODE

_AGAIN = "Something else configures the node; end it, and let the HAL open the device again."


def inspect_node(sdo: SdoClient, plan: Plan, node: int, identity: str) -> tuple[Check, ...]:
    """Compare a node with what it was told.

    Raises:
        DeviceSilent: It does not answer.
    """
    checks = [_device_type(sdo, plan), Check("identity", bool(identity), identity or "Not read yet: open the device.")]
    for is_good, text in compare_pdos(sdo, plan.pdos, node):
        checks.append(Check("PDO mapping", is_good, text if is_good else f"{text} {_AGAIN}"))
    period = round(HEARTBEAT_TIME * 1000)
    checks.append(_value(sdo, "heartbeat", Mapped(cia301.PRODUCER_HEARTBEAT, 0, 16), period, lambda ms: f"{ms} ms"))
    if plan.watch_time:
        watched = cia301.consumer_heartbeat(OWN_NODE, plan.watch_time)
        checks.append(_value(sdo, "watchdog", Mapped(cia301.CONSUMER_HEARTBEAT, 1, 32), watched, _watchdog))
    for item, value in plan.writes:
        checks.append(_value(sdo, f"object {item}", item, value % (1 << item.bits), str))
    return tuple(checks)


def _device_type(sdo: SdoClient, plan: Plan) -> Check:
    found = sdo.read(cia301.DEVICE_TYPE, 0)
    profile = found & 0xFFFF
    if profile == plan.profile:
        return Check("device type", True, f"{found:08X}h, device profile {profile}.")
    return Check("device type", False, f"Device profile {profile}, not {plan.profile}. Are two node ids swapped?")


def _value(sdo: SdoClient, what: str, item: Mapped, wanted: int, describe: Callable[[int], str]) -> Check:
    """Whether an object still has the value that was written."""
    try:
        found = sdo.read(item.index, item.subindex)
    except DeviceRefused as error:
        return Check(what, False, f"{error} Is it the right EDS file?")
    if found == wanted:
        return Check(what, True, f"{describe(found)} ({item}).")
    return Check(what, False, f"{describe(found)} ({item}), and should be {describe(wanted)}. {_AGAIN}")


def _watchdog(entry: int) -> str:
    """Entry of 1016h in words."""
    if not entry & 0xFFFF:
        return "watches nobody"
    return f"stops {entry & 0xFFFF} ms after the last heartbeat of node {entry >> 16 & 0x7F}"
