"""What can be wrong with hardware or with its description."""


class HalError(Exception):
    """Base of every exception that `hal` raises on purpose."""


class ConfigError(HalError):
    """The robot file is wrong; the message says where, what was possible, and what to check."""


class DeviceSilent(HalError):
    """A device did not answer in time."""


class DeviceRefused(HalError):
    """A device answered, and refused or contradicted what was asked."""


class WrongDevice(HalError):
    """Another device than the robot file names answers at this address."""


class BusGone(HalError):
    """The bus interface vanished or its peer died."""


class CommandRefused(HalError):
    """A command was not accepted; nothing moved because of it."""
