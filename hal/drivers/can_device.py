"""A device on a CAN bus."""

from hal.drivers.bus_device import BusDevice, DeviceSettings, Place
from hal.wire.bus import Bus

__all__ = ["CanDevice", "DeviceSettings", "Place"]


class CanDevice(BusDevice[Bus]):
    """A device that answers once in every cycle with CAN frames."""
