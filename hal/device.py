"""The contract of a device: open, enable, read, apply, stop, close.

A device serves one or more elements of the robot's signals (`muscle_length.biceps`), in SI units. A driver contains no
safety code: `hal.robot` applies limits, command age and watchdogs to every device in the same way.
"""

import abc
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from hal.errors import CommandRefused


class DeviceState(StrEnum):
    """State of a device."""

    CLOSED = "closed"
    OPENING = "opening"
    READY = "ready"
    """The device answers and measures, but does not move."""
    ENABLED = "enabled"
    """The device follows the applied set-points."""
    HOMING = "homing"
    """The device moves by itself to find its zero."""
    STOPPING = "stopping"
    """The device comes to rest by itself and then disables; it still has power."""
    FAULT = "fault"
    """The device reports a fault, which only `reset` ends."""
    SILENT = "silent"
    """The device answered before and does not answer any more."""


UNDER_POWER = (DeviceState.ENABLED, DeviceState.HOMING, DeviceState.STOPPING)


@dataclass(frozen=True, slots=True)
class Reading:
    """Newest measurement of a device.

    Attributes:
        values: One value per element of `Device.measures` [the signal's unit], shape (n,); NaN before the first.
        received: Monotonic time [s] at which each value arrived, shape (n,); -inf before the first.
    """

    values: np.ndarray
    received: np.ndarray


@dataclass(slots=True)
class DeviceHealth:
    """Report of a device about itself; for status messages, not for control."""

    state: DeviceState = DeviceState.CLOSED
    text: str = ""
    """Problem and remedy in one sentence for the operator; empty without a problem."""
    counters: dict[str, int] = field(default_factory=dict)
    """Numbers of malformed frames, missed cycles, emergencies, reboots and so on since `open`."""

    def plain(self) -> dict[str, Any]:
        """Return the report as plain values."""
        return {"state": self.state.value, "text": self.text, "counters": dict(self.counters)}


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check, for the operator.

    Attributes:
        what: Subject of the check, as in `PDO mapping`.
        is_good: Whether the subject is as required.
        text: Result, and the remedy if it is not good.
    """

    what: str
    is_good: bool
    text: str


class Device(abc.ABC):
    """A device of the robot that measures or moves.

    Only `open`, `close` and `inspect` may block longer than it takes to send a frame: all other methods are called
    from the cycle. `enable`, `disable`, `quick_stop`, `home`, `tare` and `reset` only send a request; `health` reports
    its result.
    """

    name: str
    identity: str = ""
    """Identity of this very device, as `canopen:<vendor>-<product>-<serial>`; empty before `open`, or if unknown."""
    long_request: Callable[[], None] | None = None
    """Request that takes longer than a cycle; the caretaker runs it in a thread."""
    origin: int = 0
    """Number that changes when its measurements begin anew, because it was opened or homed."""
    compliance: float = 0.0
    """Distance from its set-point at which a healthy drive pushes with its largest effort [unit of the command]."""
    can_damp: bool = False
    """Whether the device implements `damp`."""
    measures: tuple[str, ...] = ()
    """Elements that `read` returns, in order."""
    commands: tuple[str, ...] = ()
    """Elements that `apply` takes, in order; empty for a sensor."""
    command_quantity: str = "position"
    """Quantity that `apply` takes: `position`, `velocity` or `effort`."""
    fastest: float = math.inf
    """Highest speed of the commanded element [its unit/s] that the drive can reach, as far as it is known: some drives
    report it to `inspect`."""
    served: Mapping[str, str] = MappingProxyType({})
    """Quantity (`position`, `velocity`, `effort`, ...) -> `signal.element`, where the quantity is known."""

    @abc.abstractmethod
    def open(self) -> None:
        """Check that the right device answers, and configure it. May block for seconds.

        Raises:
            DeviceSilent: No device answers.
            WrongDevice: Another device answers.
            DeviceRefused: The device refuses its configuration.
        """

    @abc.abstractmethod
    def read(self) -> Reading:
        """Return the newest values and their arrival times without blocking; no value may look newer than it is."""

    @abc.abstractmethod
    def health(self) -> DeviceHealth:
        """Return state, a sentence and counters."""

    @property
    def has_power(self) -> bool:
        """Whether the device reports that its motor has power; it may still have power in fault."""
        return self.health().state in UNDER_POWER

    @abc.abstractmethod
    def close(self) -> None:
        """Disable and release the device. Safe to call twice, and when the bus is gone."""

    def enable(self) -> None:
        """Ask the device to follow commands, from its present position."""

    def disable(self) -> None:
        """Ask the device to switch its motor off."""

    def quick_stop(self) -> None:
        """Ask the device to come to rest as fast as it can, and then to switch its motor off."""
        self.disable()

    def home(self) -> None:
        """Ask the device to find its zero, which moves it; its state is `homing` until then.

        Raises:
            CommandRefused: The device cannot find its zero, or not now.
        """
        raise CommandRefused(f"'{self.name}' has no homing of its own.")

    def tare(self) -> None:
        """Ask the device to take the present measurement as zero.

        Raises:
            CommandRefused: The device cannot do this, or not now.
        """
        raise CommandRefused(f"'{self.name}' cannot be tared.")

    def reset(self) -> None:
        """Ask the device to leave a fault, without enabling it."""

    def apply(self, values: np.ndarray) -> None:
        """Send set-points [the signal's unit], shape (len(commands),), already limited by `Robot`."""
        raise NotImplementedError(f"{self.name} takes no commands")

    def damp(self) -> None:
        """Resist motion without holding a position; called instead of `apply`."""
        raise NotImplementedError(f"{self.name} cannot damp")

    def inspect(self) -> tuple[Check, ...]:
        """Read back the configuration of the device. May block; never called while the robot cycles.

        Raises:
            DeviceSilent: The device does not answer.
        """
        return ()

    def idle(self) -> None:
        """Continue the device's state machine; called instead of `apply` in every cycle without a set-point."""
