"""Books of the buses of a robot file: data sheets, PDO mappings, DBC files, ranges of MIT drives."""

import math
from typing import Any

from hal import registry
from hal.clock import SystemClock
from hal.commissioning.node import cob_id
from hal.config import RobotConfig
from hal.device import Device
from hal.drivers.canopen.node import CanopenNode, data_sheet
from hal.drivers.dbc.sequence import Address
from hal.finding.book import EXTENDED, Book, Explain
from hal.fleet import build
from hal.protocols import cia301, dbc, mit
from hal.protocols.mit import Layout, Ranges
from hal.wire.bus import OWN_NODE


def books(config: RobotConfig) -> dict[str, Book]:
    """Return the book of each bus.

    Raises:
        ConfigError: The devices of the robot file cannot be built.
    """
    result = {name: Book() for name in config.buses}
    for book in result.values():
        book.names[OWN_NODE] = "HAL"
    _, devices = build(config, SystemClock(), {})
    for device in devices:
        entry = config.devices[device.name]
        book = result[entry.bus]
        book.names[entry.node] = device.name
        settings = registry.equipment(config, device.name)[1]
        _note(book, config, device, entry.node, settings)
    return result


def _note(book: Book, config: RobotConfig, device: Device, node: int, settings: Any) -> None:
    if isinstance(device, CanopenNode):
        book.add(node, device.name, data_sheet(config.folder / settings.eds))
        for label, first, pdos in (
            ("RPDO", cia301.RPDO1, device.pdos.receives),
            ("TPDO", cia301.TPDO1, device.pdos.sends),
        ):
            for pdo in pdos:
                book.carry(node, f"{label}{pdo.number}", cob_id(first, pdo.number, node), pdo.objects)
    elif hasattr(settings, "dbc"):
        _note_dbc(book, dbc.load(config.folder / settings.dbc), Address(node, settings.node_offset, settings.extended))
    elif hasattr(settings, "actuator"):
        _note_mit(book, node, settings)


def _note_dbc(book: Book, file: dbc.Dbc, address: Address) -> None:
    for message in file.messages:
        base, extended = address.identifier(message.frame_id, message.is_extended_frame, message.name)

        def explain(data: bytes, message: Any = message) -> tuple[int | None, str]:
            try:
                values = message.decode(data, allow_truncated=True)
            except Exception as error:  # a decoder of cantools may raise anything
                return address.node, f"{message.name}: {error}"
            parts = (
                f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}"
                for name, value in values.items()
            )
            return address.node, f"{message.name}: {', '.join(parts)}"

        book.explain(base | (EXTENDED if extended else 0), "DBC", explain)


def _note_mit(book: Book, node: int, settings: Any) -> None:
    layout, ranges = settings.actuator
    reply = settings.master_id
    if reply is None:
        reply = node + 16 if layout is Layout.DAMIAO else 0
    book.explain(node, "MIT", lambda data: (node, _command(data, ranges)))
    others = book.explainers[reply][1] if reply in book.explainers else None
    book.explain(reply, "MIT", _answers(node, layout, ranges, others))


def _command(data: bytes, ranges: Ranges) -> str:
    command = mit.parse_command(data, ranges)
    if command is None:
        return "malformed"
    if isinstance(command, mit.Special):
        return command.name.lower()
    return (
        f"go to {command.position:.4g} rad at {command.velocity:.4g} rad/s with {command.stiffness:.4g} N m/rad, "
        f"{command.damping:.4g} N m s/rad, and {command.effort:.4g} N m"
    )


def _answers(node: int, layout: Layout, ranges: Ranges, others: Explain | None) -> Explain:
    """Return an explainer of the answers of one drive, which passes answers of others to their explainer."""
    mask = 0x0F if layout is Layout.DAMIAO else 0xFF

    def explain(data: bytes) -> tuple[int | None, str]:
        if (not data or data[0] & mask != node & mask) and others is not None:
            return others(data)
        answer = mit.parse_answer(data, layout, ranges)
        if answer is None:
            return node, "malformed"
        if answer.node != node & mask:
            return None, f"of drive {answer.node}, which is not in the robot file"
        heat = "" if math.isnan(answer.temperature) else f", {answer.temperature:g} degrees Celsius"
        state = f", state {answer.state:X}h" if answer.state else ""
        return node, f"at {answer.position:.4g} rad, {answer.velocity:.4g} rad/s, {answer.effort:.4g} N m{heat}{state}"

    return explain
