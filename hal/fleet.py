"""The buses and devices that a robot file names, built but not opened."""

from hal import budget, registry
from hal.bus import Bus, BusClock
from hal.config import RobotConfig
from hal.device import Device
from hal.drivers.canopen_node import Place, read_settings


def build(config: RobotConfig, clock: BusClock) -> tuple[list[Bus], list[Device]]:
    """Make every bus and every device of a robot.

    Raises:
        ConfigError: An unknown driver or interface, settings that do not fit, or a bus that would carry too much.
    """
    budget.check(config)
    buses = {name: Bus(name, bus, clock) for name, bus in config.buses.items()}
    devices: list[Device] = []
    for name, entry in config.devices.items():
        driver = registry.driver(config.kinds[entry.kind].driver)
        place = Place(name, entry.element, buses[entry.bus], entry.node, config.folder, config.rates.hal)
        devices.append(driver(place, read_settings(driver.Settings, config.settings_of(name), name)))
    return list(buses.values()), devices
