"""The contract of a device: open, enable, read, apply, stop, close.

A device serves one or more elements of the robot's signals (`muscle_length.biceps`), in SI units. A driver holds no
safety code: limits, command age and watchdogs wrap every device alike (see `hal.robot`).
"""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from hal.errors import CommandRefused


class DeviceState(StrEnum):
    """Where a device stands."""

    CLOSED = "closed"
    OPENING = "opening"
    READY = "ready"
    """Answers and measures, does not move."""
    ENABLED = "enabled"
    """Follows what is applied."""
    HOMING = "homing"
    """Moves by itself to find its zero."""
    STOPPING = "stopping"
    """Comes to rest by itself and lets go then; still under power."""
    FAULT = "fault"
    """Reports a fault of its own; leaves it only by `reset`."""
    SILENT = "silent"
    """Was heard, and is not heard any more."""


UNDER_POWER = (DeviceState.ENABLED, DeviceState.HOMING, DeviceState.STOPPING)


@dataclass(frozen=True, slots=True)
class Reading:
    """What a device last measured.

    Attributes:
        values: One value per element of `Device.measures` [the signal's unit], shape (n,); NaN if never measured.
        received: Monotonic time [s] at which each value arrived, shape (n,); -inf if never.
    """

    values: np.ndarray
    received: np.ndarray


@dataclass(slots=True)
class DeviceHealth:
    """What a device says of itself; for status messages, not for control."""

    state: DeviceState = DeviceState.CLOSED
    text: str = ""
    """One sentence a person can act on; empty when all is well."""
    counters: dict[str, int] = field(default_factory=dict)
    """Malformed frames, missed cycles, emergencies, reboots and the like, since opened."""

    def plain(self) -> dict[str, Any]:
        """The same in plain values."""
        return {"state": self.state.value, "text": self.text, "counters": dict(self.counters)}


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at, for a person who looks for what is wrong.

    Attributes:
        what: What was looked at, as in `PDO mapping`.
        is_good: Whether it is as it should be.
        text: What was found, and if it is not good, what to do.
    """

    what: str
    is_good: bool
    text: str


class Device(abc.ABC):
    """One thing on the robot that measures or moves.

    No method but `open`, `close` and `inspect` may block longer than it takes to put a frame on the bus: the rest is
    called from the cycle. `enable`, `disable`, `quick_stop`, `home`, `tare` and `reset` ask; `health` tells when it has
    happened.
    """

    name: str
    identity: str = ""
    """What tells this very device from all others of its kind, as `canopen:<vendor>-<product>-<serial>`; empty before
    it was opened, or if it cannot tell."""
    errand: Callable[[], None] | None = None
    """What was asked for and takes longer than a cycle; whoever looks after the devices takes it and runs it."""
    can_damp: bool = False
    """Whether `damp` does something."""
    measures: tuple[str, ...] = ()
    """Elements that `read` returns, in order."""
    commands: tuple[str, ...] = ()
    """Elements that `apply` takes, in order; empty for a sensor."""
    command_quantity: str = "position"
    """What `apply` takes: `position`, `velocity` or `effort`."""
    served: Mapping[str, str] = MappingProxyType({})
    """Quantity (`position`, `velocity`, `effort`, ...) -> `signal.element`, for the elements whose nature it knows."""

    @abc.abstractmethod
    def open(self) -> None:
        """Check that the right device answers, and configure it. May block for seconds.

        Raises:
            DeviceSilent: Nothing answers.
            WrongDevice: Something else answers.
            DeviceRefused: It refuses its configuration.
        """

    @abc.abstractmethod
    def read(self) -> Reading:
        """The newest values and when they arrived; never blocks, never makes a value look newer than it is."""

    @abc.abstractmethod
    def health(self) -> DeviceHealth:
        """State, a sentence and counters."""

    @property
    def has_power(self) -> bool:
        """Whether its motor has power, as far as it tells; a device in fault may have it still."""
        return self.health().state in UNDER_POWER

    @abc.abstractmethod
    def close(self) -> None:
        """Disable and let go. Safe to call twice, and when the bus is gone."""

    def enable(self) -> None:
        """Ask to follow commands, starting from where the device is."""

    def disable(self) -> None:
        """Ask to stop following and to be safe without power."""

    def quick_stop(self) -> None:
        """Ask to come to rest as fast as the device itself can, and to be safe without power then."""
        self.disable()

    def home(self) -> None:
        """Ask to find the zero, which moves the device; its state is `homing` until it has.

        Raises:
            CommandRefused: It cannot, or not now.
        """
        raise CommandRefused(f"'{self.name}' has no homing of its own.")

    def tare(self) -> None:
        """Ask to take what is measured now as zero.

        Raises:
            CommandRefused: It cannot, or not now.
        """
        raise CommandRefused(f"'{self.name}' cannot be tared.")

    def reset(self) -> None:
        """Ask to leave a fault; never enables."""

    def apply(self, values: np.ndarray) -> None:
        """Send set-points [the signal's unit], shape (len(commands),), already limited by `Robot`."""
        raise NotImplementedError(f"{self.name} takes no commands")

    def damp(self) -> None:
        """Called instead of `apply` in a cycle in which it shall resist motion without holding a place."""
        raise NotImplementedError(f"{self.name} cannot damp")

    def inspect(self) -> tuple[Check, ...]:
        """Read back what the device was told. May block; never called while the robot cycles.

        Raises:
            DeviceSilent: It does not answer.
        """
        return ()

    def idle(self) -> None:
        """Called instead of `apply` in every cycle that has no set-point; may keep a state machine going."""
