"""Drives and encoders of an arm from a URDF: those of the robot file, and the drives feel the load of their joints."""

from dataclasses import replace

from hal.config import RobotConfig
from simulators.nodes.canopen.spec import DriveConstants, NodeSpec
from simulators.robots.bench.equipment import hardware as bench


def hardware(config: RobotConfig) -> list[NodeSpec]:
    """Return a node for every device of the robot file.

    Raises:
        ConfigError: A device has a driver without a simulated counterpart, or settings that do not fit.
    """
    return [_loaded(spec, config) for spec in bench(config)]


def _loaded(spec: NodeSpec, config: RobotConfig) -> NodeSpec:
    load = config.devices[spec.name].elements.get("effort")
    if load is None or not isinstance(spec.constants, DriveConstants):
        return spec
    return replace(spec, constants=replace(spec.constants, load=load))
