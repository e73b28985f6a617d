"""The buses and devices that a robot file names, built but not opened."""

import math
from collections.abc import Mapping
from typing import Any

from hal import registry
from hal.calibration import store
from hal.calibration.line import Calibration
from hal.clock import BusClock
from hal.config import DeviceConfig, RobotConfig
from hal.device import Device
from hal.drivers.can_device import Place
from hal.errors import ConfigError
from hal.wire import budget
from hal.wire.bus import Bus


def build(
    config: RobotConfig, clock: BusClock, calibrations: Mapping[str, Calibration] | None = None
) -> tuple[list[Bus], list[Device]]:
    """Make every bus and every device of a robot.

    Args:
        config: The robot file.
        clock: What the devices go by.
        calibrations: Device -> what was measured of it; those that are stored beside the robot file if not given.

    Raises:
        ConfigError: An unknown driver or interface, settings that do not fit, a bus that would carry too much, or a
            stored calibration that is refused.
    """
    if calibrations is None:
        calibrations = store.load(config)
    budget.check(config)
    buses = {name: Bus(name, bus, clock) for name, bus in config.buses.items()}
    devices: list[Device] = []
    for name, entry in config.devices.items():
        calibration = calibrations.get(name)
        driver, settings = registry.equipment(config, name, calibration.settings if calibration else None)
        elements = _elements(driver, settings, entry, name)
        bounds = _bounds(config, elements.get(driver.commanded(settings)))
        place = Place(
            name, elements, buses[entry.bus], entry.node, config.folder, config.rates.hal, calibration, bounds
        )
        devices.append(driver(place, settings))
    return list(buses.values()), devices


def _elements(driver: Any, settings: Any, entry: DeviceConfig, name: str) -> dict[str, str]:
    """Quantity of the driver -> `signal.element`, in the driver's order.

    Raises:
        ConfigError: A quantity that the driver does not have, or not the one that it commands.
    """
    known = driver.quantities(settings)
    wanted = entry.elements if entry.element is None else {known[0]: entry.element}
    unknown = sorted(set(wanted) - set(known))
    if unknown:
        raise ConfigError(
            f"Device '{name}' has no quantity {', '.join(unknown)}. With these settings it has {', '.join(known)}."
        )
    commanded = driver.commanded(settings)
    if commanded is not None and commanded not in wanted:
        raise ConfigError(
            f"Device '{name}' is commanded by its {commanded}, which `elements` does not name. "
            f"Add `{commanded}: signal.element`, or set another mode."
        )
    return {quantity: wanted[quantity] for quantity in known if quantity in wanted}


def _bounds(config: RobotConfig, element: str | None) -> tuple[float, float]:
    """Lowest and highest set-point of a commanded element [its unit]; infinite where not stated."""
    if element is None:
        return -math.inf, math.inf
    signal, _, name = element.partition(".")
    low, high = config.bounds(signal)
    index = config.signals[signal].elements.index(name)
    return float(low[index]), float(high[index])
