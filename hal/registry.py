"""Objects that a robot file names (drivers, simulators, functions), imported on demand."""

import importlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.reading.mistakes import explain

DRIVERS = {
    "cia402": "hal.drivers.cia402:Cia402Drive",
    "cia401": "hal.drivers.canopen:Cia401Input",
    "cia404": "hal.drivers.canopen:Cia404Cell",
    "cia406": "hal.drivers.canopen:Cia406Encoder",
    "mit": "hal.drivers.mit:MitDrive",
    "dbc": "hal.drivers.dbc:DbcNode",
    "dbc_servo": "hal.drivers.dbc:DbcServo",
    "odrive": "hal.drivers.odrive:Odrive",
    "feetech": "hal.drivers.serial:FeetechServo",
    "dynamixel": "hal.drivers.serial:DynamixelServo",
}


def load_object(name: str, what: str = "function", needs: Sequence[str] = ("__call__",)) -> Any:
    """Import and return the object `module:name`.

    Args:
        name: Module and object; never of Python's own modules, which have no part of a robot.
        what: Kind of the object, for the message.
        needs: An object of this kind has these attributes.

    Raises:
        ConfigError: The name is malformed, the module or the object does not exist, or it is of another kind.
    """
    module_name, colon, attribute = name.partition(":")
    if not (colon and module_name and attribute):
        raise ConfigError(f"'{name}' is not of the form 'module:name', as my_sim:simulator is.")
    if module_name.partition(".")[0] in sys.stdlib_module_names:
        raise ConfigError(f"'{name}' is a part of Python and not a {what} of a robot. Name one of your own modules.")
    try:
        module = importlib.import_module(module_name)
    except (ImportError, TypeError, ValueError) as error:  # a relative name is a TypeError
        raise ConfigError(
            f"'{name}' cannot be loaded: {error}. Is its package installed, or the module beside the robot file?"
        ) from error
    try:
        named = getattr(module, attribute)
    except AttributeError:
        known = sorted(key for key, value in vars(module).items() if not key.startswith("_") and callable(value))
        raise ConfigError(f"Module '{module_name}' has no '{attribute}'. It has: {', '.join(known)}.") from None
    if missing := [need for need in needs if not hasattr(named, need)]:
        raise ConfigError(f"'{name}' is not a {what}: it has no {', no '.join(missing)}.")
    return named


def driver(name: str) -> Any:
    """Return the driver class of a kind: a known name, or `module:name` of your own driver.

    Raises:
        ConfigError: The driver is unknown.
    """
    if ":" in name:
        return load_object(name, "driver", ("Settings",))
    if name not in DRIVERS:
        raise ConfigError(f"There is no driver '{name}'. Known: {', '.join(DRIVERS)}, or 'module:name' of your own.")
    return load_object(DRIVERS[name], "driver", ("Settings",))


def equipment(config: RobotConfig, device: str, measured: Mapping[str, Any] | None = None) -> tuple[Any, Any]:
    """Return the driver class of a device, and its settings.

    Args:
        config: The robot file.
        device: Name of the device.
        measured: Settings from a calibration; they replace those of the robot file.

    Raises:
        ConfigError: The driver or a key of the settings is unknown, or a value does not fit.
    """
    kind = driver(config.kinds[config.devices[device].kind].driver)
    try:
        return kind, kind.Settings.model_validate({**config.settings_of(device), **(measured or {})})
    except ValidationError as error:
        raise ConfigError(f"Settings of device '{device}': {explain(error, kind.Settings)}") from None
