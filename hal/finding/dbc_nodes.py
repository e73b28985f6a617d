"""Nodes of a robot file that a scan cannot ask: those with a DBC file, recognised by the messages that they send."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from hal import registry
from hal.config import RobotConfig
from hal.drivers.dbc.sequence import Address
from hal.errors import ConfigError
from hal.protocols import dbc

Identifier = tuple[int, bool]
"""An identifier on the bus, and whether it has 29 bits."""


@dataclass(frozen=True, slots=True)
class DbcDevice:
    """A device of the robot file with a DBC file.

    Attributes:
        name: Its name in the robot file.
        node: Its node id.
        sends: Identifier -> name of a message that it sends by itself.
        known: Identifiers of all messages of its DBC file.
    """

    name: str
    node: int
    sends: Mapping[Identifier, str]
    known: frozenset[Identifier]


def dbc_devices(config: RobotConfig, bus: str) -> tuple[DbcDevice, ...]:
    """Return the devices of a bus that a DBC file describes, without those of makers that the scan knows (ODrive).

    Raises:
        ConfigError: Settings or a DBC file are not valid.
    """
    devices = []
    for name, device in config.devices.items():
        if device.bus != bus or config.kinds[device.kind].driver not in ("dbc", "dbc_servo"):
            continue
        _, settings = registry.equipment(config, name)
        file = dbc.load(config.folder / settings.dbc)
        address = Address(device.node, settings.node_offset, settings.extended)
        known = {}
        for message in file.messages:
            with suppress(ConfigError):  # a message that the robot file does not use may have no identifier
                key = address.identifier(message.frame_id, message.is_extended_frame, message.name)
                known[key] = message.name
        sends = {
            identifier: message
            for identifier, message in known.items()
            if settings.periods.get(message, "cycle") != "cycle"
        }
        devices.append(DbcDevice(name, device.node, sends, frozenset(known)))
    return tuple(devices)
