"""Construction of the buses and devices of a robot file; nothing is opened here."""

import math
from collections.abc import Mapping
from typing import Any

from hal import registry
from hal.calibration import store
from hal.calibration.line import Calibration
from hal.clock import BusClock
from hal.config import BusConfig, DeviceConfig, RobotConfig
from hal.device import Device
from hal.drivers.bus_device import Place
from hal.errors import ConfigError
from hal.line import SERIAL, SerialLine
from hal.wire import budget
from hal.wire.bus import Bus
from hal.wire.contract import Wire


def build(
    config: RobotConfig, clock: BusClock, calibrations: Mapping[str, Calibration] | None = None
) -> tuple[list[Wire], list[Device]]:
    """Build every bus, every serial line and every device of a robot.

    Args:
        config: The robot file.
        clock: Clock of the buses.
        calibrations: Device -> calibration; None for the calibrations that are stored beside the robot file.

    Raises:
        ConfigError: A driver or interface is unknown, settings do not fit, the load of a bus is too high, or a stored
            calibration is refused.
    """
    if calibrations is None:
        calibrations = store.load(config)
    budget.check(config)
    buses = {name: _wire(name, bus, clock) for name, bus in config.buses.items()}
    devices: list[Device] = []
    for name, entry in config.devices.items():
        calibration = calibrations.get(name)
        driver, settings = registry.equipment(config, name, calibration.settings if calibration else None)
        _check_wire(driver, config, entry, name)
        elements = _elements(driver, settings, entry, name)
        _check_units(config, driver, settings, elements, name)
        bounds = _bounds(config, elements.get(driver.commanded(settings)))
        place: Place[Any] = Place(
            name, elements, buses[entry.bus], entry.node, config.folder, config.rates.hal, calibration, bounds
        )
        devices.append(driver(place, settings))
    return list(buses.values()), devices


def _wire(name: str, bus: BusConfig, clock: BusClock) -> Wire:
    if bus.interface not in SERIAL:
        return Bus(name, bus, clock)
    if bus.is_fd:
        raise ConfigError(
            f"buses.{name}.data_bitrate is for CAN FD, and '{bus.interface}' is a serial line. Remove it."
        )
    return SerialLine(name, bus, clock)


def _check_wire(driver: Any, config: RobotConfig, entry: DeviceConfig, name: str) -> None:
    """Check that a device is on the kind of wire that it has a plug for.

    Raises:
        ConfigError: It is a servo of a serial line on a CAN bus, or the other way round.
    """
    interface = config.buses[entry.bus].interface
    is_serial = getattr(driver, "IS_SERIAL", False)
    if is_serial != (interface in SERIAL):
        kind, wanted = ("a serial line", "serial") if is_serial else ("a CAN bus", "socketcan")
        raise ConfigError(
            f"Device '{name}' (driver '{config.kinds[entry.kind].driver}') is for {kind}, and the interface of bus "
            f"'{entry.bus}' is '{interface}'. Set `interface: {wanted}`, or another bus."
        )


def _elements(driver: Any, settings: Any, entry: DeviceConfig, name: str) -> dict[str, str]:
    """Return a map from quantity of the driver to `signal.element`, in the driver's order.

    Raises:
        ConfigError: The driver does not have a quantity, or the commanded quantity is missing.
    """
    known = driver.quantities(settings)
    elements = entry.elements if entry.element is None else {known[0]: entry.element}
    unknown = sorted(set(elements) - set(known))
    if unknown:
        raise ConfigError(
            f"Device '{name}' has no quantity {', '.join(unknown)}. With these settings it has {', '.join(known)}."
        )
    commanded = driver.commanded(settings)
    if commanded is not None and commanded not in elements:
        raise ConfigError(
            f"Device '{name}' is commanded by its {commanded}, which `elements` does not name. "
            f"Add `{commanded}: signal.element`, or set another mode."
        )
    return {quantity: elements[quantity] for quantity in known if quantity in elements}


def _check_units(config: RobotConfig, driver: Any, settings: Any, elements: Mapping[str, str], name: str) -> None:
    """Check that the signals have the units in which a device measures.

    Raises:
        ConfigError: One has another unit, so its limits would be in that unit and its numbers in the device's.
    """
    for quantity, element in elements.items():
        unit, signal = driver.unit_of(settings, quantity), element.partition(".")[0]
        if unit not in (None, config.signals[signal].unit):
            hint = " Does it lack spool_radius?" if config.signals[signal].unit in ("m", "m/s", "N") else ""
            raise ConfigError(
                f"Device '{name}' has its {quantity} in {unit}, and the unit of {signal} is "
                f"{config.signals[signal].unit}. Change the unit of the signal, or the settings of the device.{hint}"
            )


def _bounds(config: RobotConfig, element: str | None) -> tuple[float, float]:
    """Return lowest and highest set-point of a commanded element [its unit]; infinite where not stated."""
    if element is None:
        return -math.inf, math.inf
    signal, _, name = element.partition(".")
    low, high = config.bounds(signal)
    index = config.signals[signal].elements.index(name)
    return float(low[index]), float(high[index])
