"""The hardware: buses, devices, limits and time. Knows nothing of learning or of the network.

Users import from here (`from hal import open_robot`). A name is imported from its module on first use, so that
`import hal` loads neither numpy nor python-can.
"""

from importlib import import_module

TYPE_CHECKING = False

_ROOMS = {
    "hal.clock": ("Clock", "ManualClock", "SystemClock"),
    "hal.config": ("RobotConfig", "load_robot"),
    "hal.device": ("Check", "Device", "DeviceHealth", "DeviceState", "Reading"),
    "hal.errors": ("CommandRefused", "ConfigError", "DeviceRefused", "DeviceSilent", "HalError"),
    "hal.registry": ("load_object",),
    "hal.robot": ("Robot", "open_robot"),
    "hal.sample": ("Applied", "Sample"),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}
__all__ = sorted(_ROOM_OF)

if TYPE_CHECKING:
    from hal.clock import Clock as Clock
    from hal.clock import ManualClock as ManualClock
    from hal.clock import SystemClock as SystemClock
    from hal.config import RobotConfig as RobotConfig
    from hal.config import load_robot as load_robot
    from hal.device import Check as Check
    from hal.device import Device as Device
    from hal.device import DeviceHealth as DeviceHealth
    from hal.device import DeviceState as DeviceState
    from hal.device import Reading as Reading
    from hal.errors import CommandRefused as CommandRefused
    from hal.errors import ConfigError as ConfigError
    from hal.errors import DeviceRefused as DeviceRefused
    from hal.errors import DeviceSilent as DeviceSilent
    from hal.errors import HalError as HalError
    from hal.registry import load_object as load_object
    from hal.robot import Robot as Robot
    from hal.robot import open_robot as open_robot
    from hal.sample import Applied as Applied
    from hal.sample import Sample as Sample
else:

    def __getattr__(name: str) -> object:
        """Import an exported name from its module."""
        if name not in _ROOM_OF:
            raise AttributeError(f"module 'hal' has no attribute '{name}'")
        globals()[name] = value = getattr(import_module(_ROOM_OF[name]), name)
        return value


def __dir__() -> list[str]:
    """Return the exported names."""
    return __all__
