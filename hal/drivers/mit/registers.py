"""Registers of a Damiao drive: its ranges, its mode, and the watchdog that is the only one such drives have."""

import math
import threading

import can

from hal.device import Check
from hal.drivers.can_device import Place
from hal.errors import ConfigError, DeviceRefused, DeviceSilent, WrongDevice
from hal.protocols import mit
from hal.protocols.mit import Ranges, Register

ANSWER_TIMEOUT = 0.05
"""How long [s] a register may take to be answered."""
TRIES = 4
FEWEST_FRAMES = 3
"""So many frames must fit into `watch_time`."""
RANGES = (
    (Register.POSITION_RANGE, "position"),
    (Register.VELOCITY_RANGE, "velocity"),
    (Register.EFFORT_RANGE, "effort"),
)


class RegisterClient:
    """Reads and writes registers of one Damiao drive; each answer is matched with its request."""

    def __init__(self, place: Place, watch_time: float) -> None:
        """Prepare for one drive, which is to power off after `watch_time` [s] without a frame.

        Raises:
            ConfigError: One lost frame would make it power off.
        """
        frames = watch_time * place.rate
        if frames < FEWEST_FRAMES:
            raise ConfigError(
                f"{place}: in watch_time {watch_time:g} s it gets {frames:.1f} frames at {place.rate:g} Hz, so that "
                f"one lost frame would stop it. Give it time for {FEWEST_FRAMES}."
            )
        self._node = place.node
        self._label = str(place)
        self._bus = place.bus
        self._timeout = round(watch_time / mit.TIMEOUT_UNIT)
        self._answered = threading.Event()
        self.wanted: Register | None = None
        """Asked for, and not answered yet."""
        self.found: mit.RegisterAnswer | None = None
        """The newest answer since something was asked for."""

    def take(self, found: mit.RegisterAnswer) -> None:
        """An answer has come; called in the receive thread."""
        if found.register == self.wanted:
            self.found, self.wanted = found, None
            self._answered.set()

    def ask(self, register: Register, value: int | None = None) -> None:
        """Ask to read a register, or to set it, without waiting."""
        self.wanted, self.found = register, None
        node = self._node
        data = mit.read_register(node, register) if value is None else mit.write_register(node, register, value)
        self._bus.send(can.Message(arbitration_id=mit.REGISTERS, is_extended_id=False, data=data))

    def commission(self, ranges: Ranges) -> None:
        """Check that the drive has these ranges; set its mode and its watchdog.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: Another value is read back.
            WrongDevice: It has other ranges.
        """
        for register, name in RANGES:
            theirs, ours = self.read(register).real, getattr(ranges, name)
            if not math.isclose(theirs, ours, rel_tol=1e-3):
                raise WrongDevice(
                    f"{self._label} has a {name} range of {theirs:g}, and its motor in the robot file {ours:g}. "
                    f"Is it another motor? If not, say `ranges: {{{name}: {theirs:g}}}`."
                )
        self.write(Register.MODE, mit.MIT_MODE)
        self.write(Register.TIMEOUT, self._timeout)

    def release(self) -> None:
        """Switch the watchdog off, when nobody is left to keep it from tripping.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: Another value is read back.
        """
        self.write(Register.TIMEOUT, 0)

    @property
    def is_watching(self) -> bool | None:
        """Whether the watchdog is as it was set, by the newest answer; None if there was none since it was asked."""
        found = self.found
        return None if found is None else found.register == Register.TIMEOUT and found.integer == self._timeout

    def inspect(self, ranges: Ranges) -> tuple[Check, ...]:
        """What the registers say now.

        Raises:
            DeviceSilent: No answer.
        """
        timeout, mode = self.read(Register.TIMEOUT).integer, self.read(Register.MODE).integer
        checks = [
            Check("watchdog", timeout == self._timeout, f"It powers off after {timeout * mit.TIMEOUT_UNIT:g} s."),
            Check("control mode", mode == mit.MIT_MODE, f"Register 10 is {mode}; MIT mode is {mit.MIT_MODE}."),
        ]
        for register, name in RANGES:
            theirs, ours = self.read(register).real, getattr(ranges, name)
            same = math.isclose(theirs, ours, rel_tol=1e-3)
            checks.append(Check(f"{name} range", same, f"It has {theirs:g}, the robot file {ours:g}."))
        return tuple(checks)

    def read(self, register: Register) -> mit.RegisterAnswer:
        """A register's value.

        Raises:
            DeviceSilent: No answer.
        """
        return self._exchange(register, None)

    def write(self, register: Register, value: int) -> None:
        """Write, read back and compare.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: Another value is read back.
        """
        self._exchange(register, value)
        found = self.read(register).integer
        if found != value:
            raise DeviceRefused(
                f"{self._label}: register {register.name} reads back {found} after writing {value}. "
                "Is it writable in this firmware?"
            )

    def _exchange(self, register: Register, value: int | None) -> mit.RegisterAnswer:
        for _ in range(TRIES):
            self._answered.clear()
            self.ask(register, value)
            if self._answered.wait(ANSWER_TIMEOUT) and self.found is not None:
                return self.found
        self.wanted = None
        raise DeviceSilent(
            f"{self._label} does not answer register {register.name}. Has its firmware registers, is it a Damiao drive?"
        )
