"""For each device of a robot file the node that answers in its place, with the constants that the file claims."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.protocols.analog import UNITS
from simulators.nodes.canopen.analog_input import AnalogConstants
from simulators.nodes.canopen.spec import CellConstants, Constants, DriveConstants, EncoderConstants, NodeSpec
from simulators.nodes.dbc.sensor import DbcConstants
from simulators.nodes.mit_drive import MitConstants
from simulators.nodes.odrive import OdriveConstants
from simulators.nodes.serial.node import SerialConstants

FULL_SCALE = {"int16": 2**15, "int32": 2**31, "float32": 10.0, "zc_sg": 10.0}
"""Preset -> reading of an analogue input at its end."""

SPEEDS = {"counts/s": 0x00B50300, "rps": 0x00B40300, "rpm": 0x00B44700, "0.1 rpm": 0xFFB44700, "mrpm": 0xFDB44700}
"""Unit in a robot file -> object 60A9h of a drive."""


def _cia401(settings: Any) -> Constants:
    gain, zero = _first(settings.gain), _first(settings.zero)
    bits = settings.resolution or (24 if settings.preset == "int32" else 16)
    return AnalogConstants(full_scale=gain * FULL_SCALE[settings.preset], bits=bits, unbalance=-zero)


def _cia402(settings: Any) -> Constants:
    return DriveConstants(
        counts_per_turn=round(settings.counts_per_turn),
        gear=settings.gear,
        spool_radius=settings.spool_radius,
        direction=settings.direction,
        zero=settings.zero,
        rated_torque=settings.rated_torque or DriveConstants().rated_torque,
        velocity_unit=SPEEDS[settings.velocity_unit or "counts/s"],
    )


def _cia404(settings: Any) -> Constants:
    gain, zero = _first(settings.gain) or 1.0, _first(settings.zero)
    if settings.preset in ("counts16", "counts32"):
        return CellConstants(counts_per_newton=1.0 / gain, unbalance=-zero)
    size = gain * (UNITS[settings.unit].scale if settings.unit in UNITS else 1.0)
    digits = 2 if settings.digits is None else settings.digits
    if settings.measures == "pressure":
        return CellConstants(1e7, 100.0, -zero, digits, unit=0x00220000, unit_size=size)
    return CellConstants(unbalance=-zero, decimal_digits=digits, unit_size=size)


def _cia406(settings: Any) -> Constants:
    counts = settings.counts_per_turn or EncoderConstants().counts_per_turn
    return EncoderConstants(counts_per_turn=round(counts), direction=settings.direction, zero=settings.zero)


def _first(given: Any) -> float:
    """Return the value of all channels, or of the first one."""
    return float(given[0] if isinstance(given, tuple) else given or 0.0)


def _more(settings: Any, elements: dict[str, str]) -> tuple[str, ...]:
    """Return `signal.element` of channels 2 and up; empty for a missing cell."""
    by_number = {number: elements.get(f"{settings.measures}_{number}", "") for number in settings.channels}
    return tuple(by_number.get(number, "") for number in range(2, max(by_number) + 1))


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


def _odrive(settings: Any) -> Constants:
    def period(message: str) -> float:
        return float(settings.periods.get(message, 0.0))

    return OdriveConstants(
        gear=settings.gear,
        direction=settings.direction,
        zero=settings.zero,
        watchdog=settings.watchdog.timeout if settings.watchdog else None,
        heartbeat=period("Heartbeat"),
        encoder=period("Get_Encoder_Estimates"),
        torques=period("Get_Torques"),
        temperatures=period("Get_Temperature"),
        is_extended=bool(settings.extended),
    )


def _feetech(settings: Any) -> Constants:
    return SerialConstants(
        gear=settings.gear,
        spool_radius=settings.spool_radius,
        direction=settings.direction,
        zero=settings.zero,
        stall_current=2.4,
    )


def _dynamixel(settings: Any) -> Constants:
    return SerialConstants(
        "dynamixel",
        model=settings.kind.number,
        gear=settings.gear,
        spool_radius=settings.spool_radius,
        direction=settings.direction,
        zero=settings.zero,
        fastest=8.0,
        has_dead_watchdog=not settings.kind.stops_alone,
    )


def _loaded(constants: SerialConstants, elements: Mapping[str, str]) -> SerialConstants:
    """Return a servo that carries the load, or else has the current, of its device."""
    if "load" in elements:
        return replace(constants, load=elements["load"], full_load=1.0)
    return replace(constants, load=elements.get("current"), full_load=constants.stall_current)


CONSTANTS: dict[str, Callable[[Any], Constants]] = {
    "cia401": _cia401,
    "cia402": _cia402,
    "cia404": _cia404,
    "cia406": _cia406,
    "mit": _mit,
    "odrive": _odrive,
    "feetech": _feetech,
    "dynamixel": _dynamixel,
}
"""Driver of `hal.registry` -> constants of its simulated counterpart: one line per kind."""

BY_DBC = ("dbc", "dbc_servo")
"""These drivers have a counterpart that follows their settings and DBC file."""

MAIN = "position"


def hardware(config: RobotConfig) -> list[NodeSpec]:
    """Return a node for every device of a robot file.

    Raises:
        ConfigError: A device has a driver without a simulated counterpart, or settings that do not fit.
    """
    nodes = []
    for name, device in config.devices.items():
        kind = config.kinds[device.kind].driver
        if kind not in (*CONSTANTS, *BY_DBC):
            known = ", ".join((*CONSTANTS, *BY_DBC))
            raise ConfigError(f"The bench has no other end for device '{name}' (driver '{kind}'). It has: {known}.")
        driver, settings = registry.equipment(config, name)
        element = device.elements.get(MAIN, device.served[0])
        if kind in BY_DBC:
            main = driver.commanded(settings) or next(iter(settings.quantities))
            elements = device.elements or {main: device.served[0]}
            element = elements.get(MAIN) or elements.get(main) or device.served[0]
            nodes.append(
                NodeSpec(name, device.bus, device.node, element, DbcConstants(settings, config.folder, elements))
            )
            continue
        constants: Any = CONSTANTS[kind](settings)
        if hasattr(settings, "channels"):
            constants = replace(constants, more=_more(settings, device.elements))
        if isinstance(constants, DriveConstants):
            constants = replace(constants, load=device.elements.get("effort"))
        elif isinstance(constants, SerialConstants):
            constants = _loaded(constants, device.elements)
        sheet = config.folder / settings.eds if hasattr(settings, "eds") else None
        nodes.append(NodeSpec(name, device.bus, device.node, element, constants, sheet))
    return nodes
