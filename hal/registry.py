"""Names in a robot file -> what they stand for, imported when asked for."""

import importlib
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from hal.config import RobotConfig, explain
from hal.errors import ConfigError

DRIVERS = {
    "cia402": "hal.drivers.cia402:Cia402Drive",
    "cia401": "hal.drivers.canopen:Cia401Input",
    "cia404": "hal.drivers.canopen:Cia404Cell",
    "cia406": "hal.drivers.canopen:Cia406Encoder",
    "mit": "hal.drivers.mit:MitDrive",
    "dbc": "hal.drivers.dbc:DbcNode",
    "dbc_servo": "hal.drivers.dbc:DbcServo",
    "odrive": "hal.drivers.odrive:Odrive",
}


def load_object(name: str) -> Any:
    """Import and return the object that `module:name` stands for.

    Raises:
        ConfigError: The name is malformed, or there is no such module or no such object in it.
    """
    module_name, colon, attribute = name.partition(":")
    if not (colon and module_name and attribute):
        raise ConfigError(f"'{name}' is not of the form 'module:name'.")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"'{name}' cannot be loaded: {error}. Is the package that has it installed?") from error
    try:
        return getattr(module, attribute)
    except AttributeError:
        known = sorted(key for key, value in vars(module).items() if not key.startswith("_") and callable(value))
        raise ConfigError(f"Module '{module_name}' has no '{attribute}'. It has: {', '.join(known)}.") from None


def driver(name: str) -> Any:
    """The driver class behind a kind's `driver`: a known name, or `module:name` for one of your own.

    Raises:
        ConfigError: Unknown.
    """
    if ":" in name:
        return load_object(name)
    if name not in DRIVERS:
        raise ConfigError(f"There is no driver '{name}'. Known: {', '.join(DRIVERS)}, or 'module:name' of your own.")
    return load_object(DRIVERS[name])


def equipment(config: RobotConfig, device: str, measured: Mapping[str, Any] | None = None) -> tuple[Any, Any]:
    """The driver class of a device, and its settings.

    Args:
        config: The robot file.
        device: Name of the device.
        measured: Settings from a calibration; they take precedence over those of the robot file.

    Raises:
        ConfigError: No such driver, an unknown key among the settings, or a value that does not fit.
    """
    found = driver(config.kinds[config.devices[device].kind].driver)
    try:
        return found, found.Settings.model_validate({**config.settings_of(device), **(measured or {})})
    except ValidationError as error:
        raise ConfigError(f"Settings of device '{device}': {explain(error, found.Settings)}") from None
