"""All devices of a robot that move, asked together: one that raises keeps no other from being asked."""

from collections.abc import Callable, Sequence

import numpy as np

from hal.config import RobotConfig
from hal.device import Device, DeviceState
from hal.errors import CommandRefused, ConfigError


def find(name: str, devices: Sequence[Device]) -> Device:
    """The device of a name.

    Raises:
        CommandRefused: There is none.
    """
    found = next((device for device in devices if device.name == name), None)
    if found is None:
        raise CommandRefused(f"There is no device '{name}'. Known: {', '.join(device.name for device in devices)}.")
    return found


class Actuators:
    """The devices that command the elements of the commanded signal.

    Attributes:
        devices: Those that can be commanded.
        quantity: What they are commanded in: `position`, `velocity` or `effort`.
    """

    def __init__(self, config: RobotConfig, devices: Sequence[Device]) -> None:
        """Pick the actuators out of all devices.

        Raises:
            ConfigError: They do not command each element once, take different quantities, or cannot do what the robot
                file wants of them when the robot stops.
        """
        self.devices = tuple(device for device in devices if device.commands)
        self._places = tuple(_places(config, self.devices))
        self.quantity = _quantity(config, self.devices)
        _check_stop(config, self.quantity, self.devices)

    def each(self, act: Callable[[Device], None]) -> None:
        """Do something with every actuator, and raise what the first that failed raised only then."""
        first: Exception | None = None
        for device in self.devices:
            try:
                act(device)
            except Exception as error:  # the others must be asked all the same
                first = first or error
        if first is not None:
            raise first

    def enable(self) -> None:
        """See `Device.enable`."""
        self.each(lambda device: device.enable())

    def disable(self) -> None:
        """See `Device.disable`."""
        self.each(lambda device: device.disable())

    def quick_stop(self) -> None:
        """See `Device.quick_stop`."""
        self.each(lambda device: device.quick_stop())

    def idle(self) -> None:
        """See `Device.idle`."""
        self.each(lambda device: device.idle())

    def damp(self) -> None:
        """See `Device.damp`."""
        self.each(lambda device: device.damp())

    def apply(self, set_point: np.ndarray, may_go_on: Callable[[], bool]) -> None:
        """Send set-points [unit of the commanded signal], shape (n,), as long as `may_go_on()`."""
        for device, places in zip(self.devices, self._places, strict=True):
            if may_go_on():
                device.apply(set_point[places])

    def states(self) -> list[DeviceState]:
        """Where each stands."""
        return [device.health().state for device in self.devices]

    @property
    def are_powered(self) -> bool:
        """Whether any has power, as far as it tells."""
        return any(device.has_power for device in self.devices)

    def named(self, states: Sequence[DeviceState], wanted: DeviceState) -> str:
        """Names of those that are not in the wanted state."""
        return ", ".join(d.name for d, state in zip(self.devices, states, strict=True) if state is not wanted)


def _places(config: RobotConfig, actuators: Sequence[Device]) -> list[np.ndarray]:
    """For each actuator, where its commanded elements lie in the commanded signal."""
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
    found = {device.command_quantity: device.name for device in actuators}
    if len(found) > 1:
        told = ", ".join(f"'{name}' in {quantity}" for quantity, name in found.items())
        raise ConfigError(f"All drives of '{config.robot}' must be commanded in the same quantity, not {told}.")
    return next(iter(found), "position")


def _check_stop(config: RobotConfig, quantity: str, actuators: Sequence[Device]) -> None:
    behaviour = config.stop.behaviour
    if behaviour == "hold" and quantity == "effort":
        raise ConfigError("stop.behaviour 'hold' needs drives that hold a place; with effort commands say damp or off.")
    if behaviour == "park" and quantity != "position":
        raise ConfigError(f"stop.behaviour 'park' needs position commands; with {quantity} commands say damp or off.")
    stiff = [device.name for device in actuators if not device.can_damp]
    if behaviour == "damp" and stiff:
        raise ConfigError(f"stop.behaviour 'damp': {', '.join(stiff)} cannot damp. Say hold, park or off.")
