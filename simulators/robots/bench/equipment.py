"""For each device of a robot file the node that answers in its place, with the constants that the file claims."""

from collections.abc import Callable
from typing import Any

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from simulators.nodes.mit_drive import MitConstants
from simulators.nodes.spec import CellConstants, Constants, DriveConstants, EncoderConstants, NodeSpec


def _cia402(settings: Any) -> Constants:
    return DriveConstants(
        counts_per_turn=round(settings.counts_per_turn),
        gear=settings.gear,
        spool_radius=settings.spool_radius,
        direction=settings.direction,
        zero=settings.zero,
        rated_torque=settings.rated_torque or DriveConstants.rated_torque,
    )


def _cia404(settings: Any) -> Constants:
    return CellConstants()


def _cia406(settings: Any) -> Constants:
    counts = settings.counts_per_turn or EncoderConstants.counts_per_turn
    return EncoderConstants(counts_per_turn=round(counts), direction=settings.direction, zero=settings.zero)


def _mit(settings: Any) -> Constants:
    layout, ranges = settings.actuator
    return MitConstants(
        make=layout.value,
        master_id=settings.master_id,
        position=ranges.position,
        velocity=ranges.velocity,
        torque=ranges.effort,
        stiffness=ranges.stiffness,
        damping=ranges.damping,
        gear=settings.gear,
        spool_radius=settings.spool_radius,
        direction=settings.direction,
        zero=settings.zero,
    )


CONSTANTS: dict[str, Callable[[Any], Constants]] = {
    "cia402": _cia402,
    "cia404": _cia404,
    "cia406": _cia406,
    "mit": _mit,
}
"""What a driver of `hal.registry` has at the other end of the wire: one line per kind."""

MAIN = "position"


def hardware(config: RobotConfig) -> list[NodeSpec]:
    """A node for every device of a robot file.

    Raises:
        ConfigError: A device has a driver whose other end is not simulated, or settings that do not fit.
    """
    nodes = []
    for name, device in config.devices.items():
        kind = config.kinds[device.kind].driver
        if kind not in CONSTANTS:
            raise ConfigError(
                f"The bench has no other end for device '{name}' (driver '{kind}'). It has: {', '.join(CONSTANTS)}."
            )
        _, settings = registry.equipment(config, name)
        element = device.elements.get(MAIN, device.served[0])
        nodes.append(NodeSpec(name, device.bus, device.node, element, CONSTANTS[kind](settings)))
    return nodes
