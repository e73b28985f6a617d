"""Errors of the hardware and of its description."""


class HalError(Exception):
    """Base of every exception that `hal` raises on purpose."""


class ConfigError(HalError):
    """An error in the robot file; the message names the place, the alternatives, and what to check."""


class DeviceSilent(HalError):
    """No answer of a device in time."""


class DeviceRefused(HalError):
    """A refusal or contradiction in the answer of a device."""


class WrongDevice(HalError):
    """An answer from another device than the one that the robot file names at this address."""


class BusGone(HalError):
    """A bus whose interface vanished or whose peer ended."""


class CommandRefused(HalError):
    """A command that was not accepted and moved nothing."""
