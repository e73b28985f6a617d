"""All devices that move the robot, called as a group: an error of one device does not skip the others."""

from collections.abc import Callable, Sequence

import numpy as np

from hal.config import RobotConfig
from hal.device import Device, DeviceState
from hal.errors import CommandRefused, ConfigError


def find(name: str, devices: Sequence[Device]) -> Device:
    """Return the device with this name.

    Raises:
        CommandRefused: No device has this name.
    """
    for device in devices:
        if device.name == name:
            return device
    raise CommandRefused(f"There is no device '{name}'. Known: {', '.join(device.name for device in devices)}.")


class Actuators:
    """The devices that command the elements of the commanded signal.

    Attributes:
        devices: Devices that take commands.
        quantity: Commanded quantity: `position`, `velocity` or `effort`.
    """

    def __init__(self, config: RobotConfig, devices: Sequence[Device]) -> None:
        """Select the actuators among all devices.

        Raises:
            ConfigError: They do not command each element once, take different quantities, or do not support the stop
                behaviour of the robot file.
        """
        self.devices = tuple(device for device in devices if device.commands)
        self._places = tuple(_places(config, self.devices))
        self.quantity = _quantity(config, self.devices)
        _check_stop(config, self.quantity, self.devices)

    def each(self, act: Callable[[Device], None]) -> None:
        """Call a function with every actuator, then raise the first error that occurred."""
        first: Exception | None = None
        for device in self.devices:
            try:
                act(device)
            except Exception as error:  # the other actuators must be called all the same
                first = first or error
        if first is not None:
            raise first

    def enable(self) -> None:
        """Call `Device.enable` of every actuator."""
        self.each(lambda device: device.enable())

    def disable(self) -> None:
        """Call `Device.disable` of every actuator."""
        self.each(lambda device: device.disable())

    def quick_stop(self) -> None:
        """Call `Device.quick_stop` of every actuator."""
        self.each(lambda device: device.quick_stop())

    def idle(self) -> None:
        """Call `Device.idle` of every actuator."""
        self.each(lambda device: device.idle())

    def damp(self) -> None:
        """Call `Device.damp` of every actuator."""
        self.each(lambda device: device.damp())

    def apply(self, set_point: np.ndarray, may_continue: Callable[[], bool]) -> None:
        """Send set-points [unit of the commanded signal], shape (n,), while `may_continue()` is true."""
        for device, places in zip(self.devices, self._places, strict=True):
            if may_continue():
                device.apply(set_point[places])

    def states(self) -> list[DeviceState]:
        """Return the state of each actuator."""
        return [device.health().state for device in self.devices]

    @property
    def are_powered(self) -> bool:
        """Whether any actuator reports that its motor has power."""
        return any(device.has_power for device in self.devices)

    def names_not_in(self, target: DeviceState, states: Sequence[DeviceState]) -> str:
        """Return the names of the actuators that are not in the target state."""
        return ", ".join(d.name for d, state in zip(self.devices, states, strict=True) if state is not target)


def _places(config: RobotConfig, actuators: Sequence[Device]) -> list[np.ndarray]:
    """Return the indices of each actuator's commanded elements in the commanded signal."""
    signal = config.command.signal
    names = [f"{signal}.{element}" for element in config.signals[signal].elements]
    commanded = [element for device in actuators for element in device.commands]
    if sorted(commanded) != sorted(names):
        wrong = sorted(set(names) ^ set(commanded)) or sorted({e for e in commanded if commanded.count(e) > 1})
        raise ConfigError(
            f"The devices of '{config.robot}' must command each element of '{signal}' once; "
            f"that fails for {', '.join(wrong)}."
        )
    return [np.array([names.index(element) for element in device.commands]) for device in actuators]


def _quantity(config: RobotConfig, actuators: Sequence[Device]) -> str:
    names = {device.command_quantity: device.name for device in actuators}
    if len(names) > 1:
        listing = ", ".join(f"'{name}' in {quantity}" for quantity, name in names.items())
        raise ConfigError(f"All drives of '{config.robot}' must be commanded in the same quantity, not {listing}.")
    return next(iter(names), "position")


def _check_stop(config: RobotConfig, quantity: str, actuators: Sequence[Device]) -> None:
    behaviour = config.stop.behaviour
    if behaviour == "hold" and quantity == "effort":
        raise ConfigError(
            "stop.behaviour 'hold' needs drives that hold a position; with effort commands use damp or off."
        )
    if behaviour == "park" and quantity != "position":
        raise ConfigError(f"stop.behaviour 'park' needs position commands; with {quantity} commands use damp or off.")
    stiff = [device.name for device in actuators if not device.can_damp]
    if behaviour == "damp" and stiff:
        raise ConfigError(f"stop.behaviour 'damp': {', '.join(stiff)} cannot damp. Use hold, park or off.")
