"""A Feetech servo of the STS or SMS series."""

import math
from typing import cast

from typing_extensions import override

from hal.calibration.units import axis_units
from hal.device import Check
from hal.drivers.bus_device import Place
from hal.drivers.serial.servo import SerialServo
from hal.drivers.serial.settings import COUNTS, FeetechSettings
from hal.errors import DeviceRefused, WrongDevice
from hal.line import SerialLine
from hal.protocols import feetech
from hal.protocols.feetech import Register
from hal.protocols.serial_status import Packets, Status

QUANTITIES = ("position", "velocity", "load", "current", "voltage", "temperature")
_UNITS = {"load": "1", "current": "A", "voltage": "V"}
_ANGLE_ERROR = 0x02
_UNLOCKED, _LOCKED = b"\0", b"\1"


class FeetechServo(SerialServo):
    """One servo. Everything that it reports comes in one read, which also has the state of its torque."""

    Settings = FeetechSettings
    packets = cast(Packets, feetech)
    torque_register = Register.TORQUE_ENABLE
    feedback = (int(feetech.FEEDBACK[0]), int(feetech.FEEDBACK[1]))

    @classmethod
    @override
    def quantities(cls, settings: FeetechSettings) -> tuple[str, ...]:
        return (settings.mode, *(name for name in QUANTITIES if name != settings.mode))

    @classmethod
    @override
    def unit_of(cls, settings: FeetechSettings, quantity: str) -> str | None:
        return _UNITS.get(quantity) or axis_units(settings.spool_radius is not None).get(quantity)

    def __init__(self, place: Place[SerialLine], settings: FeetechSettings) -> None:
        super().__init__(place, settings)
        self._own = settings
        self._per_speed = settings.scale * 2.0 * math.pi / COUNTS

    @override
    def _identify(self) -> str:
        model = self._integer(Register.MODEL, 2)
        if model in feetech.BIG_ENDIAN:
            raise WrongDevice(
                f"{self._place} is a {feetech.BIG_ENDIAN[model]} of the SCS series, whose registers differ. Only the "
                "series STS and SMS are supported."
            )
        return f"feetech:{self._bus.name}:{self.node}:{feetech.MODELS.get(model, model)}"

    @override
    def _commission(self) -> None:
        self._enable_requested = False
        self._position = None
        self._set(Register.TORQUE_ENABLE, b"\0", "torque off")
        kept = {
            Register.RETURN_DELAY: (b"\0", "the shortest delay of answers"),
            Register.MODE: (bytes((feetech.MODES[self._own.mode],)), f"mode {self._own.mode}"),
        }
        wrong = {address: new for address, new in kept.items() if self._get(address, 1) != new[0]}
        if wrong:
            self._set(Register.LOCK, _UNLOCKED, "the unlocking of its settings")
            for address, (data, what) in wrong.items():
                self._set(address, data, what)
            self._set(Register.LOCK, _LOCKED, "the locking of its settings")
        if self._own.mode == "position":
            lowest, highest = self._integer(Register.LOWEST_ANGLE, 2), self._integer(Register.HIGHEST_ANGLE, 2)
            if (lowest, highest) != (0, 0):  # both 0: any number of turns
                self._check_bounds(lowest, highest, "registers 9 and 11")
        self._set(Register.ACCELERATION, bytes((self._own.acceleration,)), "the acceleration")
        if self._get(Register.TORQUE_ENABLE, 1) != b"\0":
            raise DeviceRefused(f"{self._place} stays under torque. Cut its power.")
        self.missed = 0

    @override
    def _note(self, status: Status) -> None:
        self._error = status.error
        self._latched |= status.error

    def take_feedback(self, status: Status, received: float) -> None:
        """Handle an answer; called in the line's thread."""
        self._note(status)
        data, base = status.data, self.feedback[0]
        self._is_powered = bool(data[0])
        if not self._may_store():
            return
        if data[Register.ACCELERATION - base] != self._own.acceleration:  # a set-point may have given it torque again
            self._counters["boots"] += 1
            self._lose(f"{self._place} was restarted. Was its supply interrupted? It is commissioned again.")
            return

        def at(address: int, sign: int = feetech.WORD_SIGN) -> int:
            return feetech.number(data[address - base : address - base + 2], sign)

        position, sign = at(Register.POSITION), self._own.direction
        values = {
            "position": math.nan if status.error & _ANGLE_ERROR else self._own.value(position),
            "velocity": math.nan if status.error & _ANGLE_ERROR else self._per_speed * at(Register.SPEED),
            "load": sign * feetech.LOAD_UNIT * at(Register.LOAD, feetech.LOAD_SIGN),
            "current": sign * feetech.CURRENT_UNIT * at(Register.CURRENT),
            "voltage": feetech.VOLTAGE_UNIT * data[Register.VOLTAGE - base],
            "temperature": float(data[Register.TEMPERATURE - base]),
        }
        self._store(position, values, received)

    @override
    def _goal(self, value: float) -> list[tuple[int, bytes]]:
        if self._own.mode == "velocity":
            return [(Register.GOAL_SPEED, feetech.word(round(value / self._per_speed)))]
        return [(Register.GOAL_POSITION, feetech.word(self._own.counts(value)))]

    @override
    def _hold_goal(self, counts: int) -> list[tuple[int, bytes]]:
        if self._own.mode == "velocity":
            return [(Register.GOAL_SPEED, feetech.word(0))]
        return [(Register.GOAL_POSITION, feetech.word(counts))]

    @override
    def _switch_on(self, counts: int) -> list[tuple[int, bytes]]:
        limit = feetech.word(round(1000 * self._own.torque_limit))
        writes = [(int(Register.TORQUE_LIMIT), limit)]
        if self._own.mode == "position":
            writes.append((Register.GOAL_SPEED, feetech.word(0)))  # 0 is the fastest here
        # The goal is first: a goal alone may switch the torque on.
        return [*writes, *self._hold_goal(counts), (Register.TORQUE_ENABLE, b"\1")]

    @override
    def _error_text(self, error: int) -> str:
        return feetech.describe_error(error)

    @override
    def _has_no_watchdog(self) -> str:
        does = "holds its last position" if self._own.mode == "position" else "continues at its last speed"
        return f"{self._place} has no watchdog: if the HAL dies while it is enabled, it {does}."

    @override
    def inspect(self) -> tuple[Check, ...]:
        mode, delay = self._get(Register.MODE, 1)[0], self._get(Register.RETURN_DELAY, 1)[0]
        level = self._get(Register.STATUS_LEVEL, 1)[0]
        right = feetech.MODES[self._own.mode]
        return (
            *super().inspect(),
            Check("mode", mode == right, f"Register 33 is {mode}, {right} is required."),
            Check("answer delay", not delay, f"Register 7 is {delay} (2 us each), 0 is required."),
            Check("answers to writes", level == 1, f"Register 8 is {level}; 1 is the usual value."),
        )
