"""A Dynamixel servo of the X series."""

import math
from typing import cast

import numpy as np
from typing_extensions import override

from hal.calibration.units import axis_units
from hal.device import Check
from hal.drivers.bus_device import Place
from hal.drivers.serial.servo import SerialServo
from hal.drivers.serial.settings import DynamixelSettings
from hal.errors import DeviceRefused, DeviceSilent, WrongDevice
from hal.line import SerialLine
from hal.protocols import dynamixel, dynamixel_models
from hal.protocols.dynamixel import Register
from hal.protocols.serial_status import Packets, Status

_UNITS = {"load": "1", "current": "A", "voltage": "V"}
_ENCODER_ERROR = 0x08
_RPM = math.pi / 30.0
_FIRST_WATCHDOG = 38
"""The bus watchdog is there from this firmware on, of the models that began before it."""


class DynamixelServo(SerialServo):
    """One servo. Its measurements come in every cycle, its torque and hardware error in turn with the other servos."""

    Settings = DynamixelSettings
    packets = cast(Packets, dynamixel)
    torque_register = Register.TORQUE_ENABLE
    feedback = (int(dynamixel.FEEDBACK[0]), int(dynamixel.FEEDBACK[1]))
    state = (int(dynamixel.STATE[0]), int(dynamixel.STATE[1]))

    @classmethod
    @override
    def quantities(cls, settings: DynamixelSettings) -> tuple[str, ...]:
        force: tuple[str, ...] = ("load",) if settings.kind.current_unit is None else ("current",)
        if settings.torque_constant:
            force = ("effort", *force)
        names = ("position", "velocity", *force, "voltage", "temperature")
        return (settings.mode, *(name for name in names if name != settings.mode))

    @classmethod
    @override
    def unit_of(cls, settings: DynamixelSettings, quantity: str) -> str | None:
        return _UNITS.get(quantity) or axis_units(settings.spool_radius is not None).get(quantity)

    def __init__(self, place: Place[SerialLine], settings: DynamixelSettings) -> None:
        super().__init__(place, settings)
        self._own = settings
        self.can_damp = settings.mode == "effort" and settings.damping is not None
        self._per_speed = settings.scale * dynamixel.VELOCITY_UNIT * _RPM
        current = settings.kind.current_unit
        self._per_force = settings.direction * (dynamixel.LOAD_UNIT if current is None else current)
        self._per_effort = (
            (settings.torque_constant or math.nan) * (current or math.nan) / settings.scale
        )  # torque times gear, over the radius
        self._watch = bytes((round(settings.watch_time / dynamixel.WATCHDOG_UNIT),))
        self._speed = math.nan
        self._is_expired = False

    @override
    def _identify(self) -> str:
        for _ in range(3):
            status = self._bus.request(self.packets.ping(self.node), self.node, 3)
            if status is not None:
                break
        else:
            raise DeviceSilent(
                f"{self._place} does not answer. Is it powered, are its id and the bit rate right, does it speak "
                "protocol 2.0?"
            )
        number, firmware = int.from_bytes(status.data[:2], "little"), status.data[2]
        if number != self._own.kind.number:
            name = dynamixel_models.NAMES.get(number, f"model number {number}")
            raise WrongDevice(f"{self._place} is a {name}, the robot file says {self._own.model}. Are two ids swapped?")
        if firmware < _FIRST_WATCHDOG and not self._own.allow_no_watchdog and number < 1160:
            raise DeviceRefused(
                f"{self._place} has firmware {firmware}, which has no bus watchdog. Update it with the maker's "
                "program, or set `allow_no_watchdog: true`."
            )
        return f"dynamixel:{self._bus.name}:{self.node}:{self._own.model}"

    @override
    def _commission(self) -> None:
        self._enable_requested = False
        self._position = None
        own = self._own
        self._bus.request(dynamixel.write(self.node, Register.STATUS_LEVEL, b"\2"), self.node, 0)
        self._set(Register.TORQUE_ENABLE, b"\0", "torque off")
        kept = {
            Register.RETURN_DELAY: (b"\0", "the shortest delay of answers"),
            Register.MODE: (bytes((own.operating_mode,)), f"operating mode {own.operating_mode}"),
        }
        for address, (data, what) in kept.items():
            if self._get(address, 1) != data:
                self._set(address, data, what)
        if self._get(Register.DRIVE_MODE, 1)[0] & 0x04:
            raise DeviceRefused(
                f"{self._place} has a profile by time (register 10, bit 2), which delays every set-point. Clear it "
                "with the maker's program."
            )
        if own.mode == "position" and not own.max_current:  # only this mode uses these registers
            lowest, highest = self._integer(Register.LOWEST_POSITION, 4), self._integer(Register.HIGHEST_POSITION, 4)
            self._check_bounds(lowest, highest, "registers 52 and 48")
        if own.mode == "velocity":
            self.fastest = abs(self._per_speed) * self._integer(Register.VELOCITY_LIMIT, 4)
        self._set(Register.WATCHDOG, b"\0", "the bus watchdog")
        self._take_state(self._get(*dynamixel.STATE))
        if self._is_powered:
            raise DeviceRefused(f"{self._place} stays under torque. Cut its power.")
        self.missed = 0

    def take_feedback(self, status: Status, received: float) -> None:
        """Handle an answer; called in the line's thread."""
        if not self._may_store():
            return
        if status.error & dynamixel.ALERT and not self._error:
            self.is_changing = True  # its state names the error
        data, base = status.data, self.feedback[0]

        def at(address: int, size: int) -> int:
            return int.from_bytes(data[address - base : address - base + size], "little", signed=True)

        position, force = at(Register.POSITION, 4), at(Register.CURRENT, 2)
        self._speed = self._per_speed * at(Register.VELOCITY, 4)
        is_blind = bool(self._error & _ENCODER_ERROR)
        values = {
            "position": math.nan if is_blind else self._own.value(position),
            "velocity": math.nan if is_blind else self._speed,
            "load": self._per_force * force,
            "current": self._per_force * force,
            "effort": self._per_effort * force,
            "voltage": dynamixel.VOLTAGE_UNIT * at(Register.VOLTAGE, 2),
            "temperature": float(data[Register.TEMPERATURE - base]),
        }
        self._store(position, values, received)

    @override
    def take_state(self, status: Status, received: float) -> None:
        self._take_state(status.data)

    def _take_state(self, data: bytes) -> None:
        base = self.state[0]
        self._is_powered = bool(data[0])
        self._error = data[Register.HARDWARE_ERROR - base]
        self._latched |= self._error
        self._is_expired = data[Register.WATCHDOG - base] == dynamixel.WATCHDOG_EXPIRED

    @override
    def _goal(self, value: float) -> list[tuple[int, bytes]]:
        if self._is_expired:  # it takes no goals any more: stop, and say why
            self._latched |= _EXPIRED
        mode = self._own.mode
        if mode == "velocity":
            return [(Register.GOAL_VELOCITY, _signed(round(value / self._per_speed), 4))]
        if mode == "effort":
            return [(Register.GOAL_CURRENT, _signed(round(value / self._per_effort), 2))]
        return [(Register.GOAL_POSITION, _signed(self._own.counts(value), 4))]

    @override
    def _hold_goal(self, counts: int) -> list[tuple[int, bytes]]:
        mode = self._own.mode
        if mode == "velocity":
            return [(Register.GOAL_VELOCITY, _signed(0, 4))]
        if mode == "effort":
            return [(Register.GOAL_CURRENT, _signed(0, 2))]
        return [(Register.GOAL_POSITION, _signed(counts, 4))]

    @override
    def _switch_on(self, counts: int) -> list[tuple[int, bytes]]:
        current = self._own.max_current
        limit = round(current / (self._own.kind.current_unit or math.inf)) if current else 0
        limits = [(int(Register.GOAL_CURRENT), _signed(limit, 2))] if current else []
        return [
            *limits,
            *self._hold_goal(counts),
            (Register.TORQUE_ENABLE, b"\1"),
            (Register.WATCHDOG, self._watch),
        ]

    @override
    def damp(self) -> None:
        damping = self._own.damping
        self.apply(np.array([-damping * self._speed if damping and math.isfinite(self._speed) else 0.0]))

    @override
    def idle(self) -> None:
        if self._is_expired and not self._is_powered and self.is_commissioned:
            self._write([(Register.WATCHDOG, b"\0")])
        else:
            super().idle()

    @override
    def reset(self) -> None:
        if self._error:
            self.long_request = self._reboot
        super().reset()

    def _reboot(self) -> None:
        """Restart the servo, the only way to end a hardware error; the caretaker opens it again."""
        self._bus.request(dynamixel.reboot(self.node), self.node, 0)
        self._lose(f"{self._place} restarts after an error.")
        self._error = self._latched = 0

    @override
    def _error_text(self, error: int) -> str:
        if error & _EXPIRED:
            return f"no packet for {self._own.watch_time:g} s, so its watchdog stopped it"
        return dynamixel.describe_error(error)

    @override
    def _has_no_watchdog(self) -> str:
        if self._own.kind.stops_alone:
            return ""
        return (
            f"The watchdog of {self._place} reports a stop that it does not perform: if the HAL dies, it follows its "
            "last set-point."
        )

    @override
    def inspect(self) -> tuple[Check, ...]:
        mode, delay = self._get(Register.MODE, 1)[0], self._get(Register.RETURN_DELAY, 1)[0]
        right = self._own.operating_mode
        return (
            *super().inspect(),
            Check("mode", mode == right, f"Register 11 is {mode}, {right} is required."),
            Check("answer delay", not delay, f"Register 9 is {delay} (2 us each), 0 is required."),
        )


_EXPIRED = 0x100
"""Beside the bits of the hardware error: the bus watchdog stopped the servo."""


def _signed(value: int, size: int) -> bytes:
    """Return a number in `size` bytes, low byte first; too large ones are cut off."""
    most = (1 << (8 * size - 1)) - 1
    return max(-most, min(most, value)).to_bytes(size, "little", signed=True)
