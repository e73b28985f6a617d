"""Registers of a Damiao drive: ranges, mode and watchdog."""

import math
import threading

import can

from hal.device import Check
from hal.drivers.can_device import Place
from hal.errors import ConfigError, DeviceRefused, DeviceSilent, WrongDevice
from hal.protocols import mit
from hal.protocols.mit import Ranges, Register

ANSWER_TIMEOUT = 0.05
"""A request is repeated after this time [s] without an answer."""
TRIES = 4
FEWEST_FRAMES = 3
"""At least this number of frames must be sent within `watch_time`."""
RANGES = (
    (Register.POSITION_RANGE, "position"),
    (Register.VELOCITY_RANGE, "velocity"),
    (Register.EFFORT_RANGE, "effort"),
)


class RegisterClient:
    """A client that reads and writes registers of one Damiao drive and matches each answer with its request."""

    def __init__(self, place: Place, watch_time: float) -> None:
        """Prepare for one drive, which must power off after `watch_time` [s] without a frame.

        Raises:
            ConfigError: `watch_time` is so short that a single lost frame would power it off.
        """
        frames = watch_time * place.rate
        if frames < FEWEST_FRAMES:
            raise ConfigError(
                f"{place}: in watch_time {watch_time:g} s it gets {frames:.1f} frames at {place.rate:g} Hz, so one "
                f"lost frame would stop it. Give it time for {FEWEST_FRAMES}."
            )
        self._node = place.node
        self._label = str(place)
        self._bus = place.bus
        self._timeout = round(watch_time / mit.TIMEOUT_UNIT)
        self._answered = threading.Event()
        self.pending: Register | None = None
        """Register of the request that is not answered yet."""
        self.answer: mit.RegisterAnswer | None = None
        """Answer to the newest request."""

    def take(self, answer: mit.RegisterAnswer) -> None:
        """Take an answer, in the receive thread."""
        if answer.register == self.pending:
            self.answer, self.pending = answer, None
            self._answered.set()

    def ask(self, register: Register, value: int | None = None) -> None:
        """Request to read a register, or to write it, without waiting."""
        self.pending, self.answer = register, None
        node = self._node
        data = mit.read_register(node, register) if value is None else mit.write_register(node, register, value)
        self._bus.send(can.Message(arbitration_id=mit.REGISTERS, is_extended_id=False, data=data))

    def commission(self, ranges: Ranges) -> None:
        """Check the ranges of the drive; set its mode and its watchdog.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: Another value is read back.
            WrongDevice: It has other ranges.
        """
        for register, name in RANGES:
            theirs, ours = self.read(register).real, getattr(ranges, name)
            if not math.isclose(theirs, ours, rel_tol=1e-3):
                raise WrongDevice(
                    f"{self._label} has a {name} range of {theirs:g}, but its motor in the robot file {ours:g}. "
                    f"Is it another motor? If not, set `ranges: {{{name}: {theirs:g}}}`."
                )
        self.write(Register.MODE, mit.MIT_MODE)
        self.write(Register.TIMEOUT, self._timeout)

    def release(self) -> None:
        """Switch the watchdog off, because no more frames will be sent.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: Another value is read back.
        """
        self.write(Register.TIMEOUT, 0)

    @property
    def is_watching(self) -> bool | None:
        """Whether the newest answer shows the watchdog as it was set; None before the answer to the newest request."""
        answer = self.answer
        return None if answer is None else answer.register == Register.TIMEOUT and answer.integer == self._timeout

    def inspect(self, ranges: Ranges) -> tuple[Check, ...]:
        """Read the registers and compare them with the settings.

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
        """Read a register.

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
        actual = self.read(register).integer
        if actual != value:
            raise DeviceRefused(
                f"{self._label}: register {register.name} reads back {actual} after writing {value}. "
                "Is it writable in this firmware?"
            )

    def _exchange(self, register: Register, value: int | None) -> mit.RegisterAnswer:
        for _ in range(TRIES):
            self._answered.clear()
            self.ask(register, value)
            if self._answered.wait(ANSWER_TIMEOUT) and self.answer is not None:
                return self.answer
        self.pending = None
        raise DeviceSilent(
            f"{self._label} does not answer register {register.name}. Is it a Damiao drive, has its firmware registers?"
        )
