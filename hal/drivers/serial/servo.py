"""A servo on a serial line, whatever its make: slots, enabling, stopping and silence.

A subclass has the registers. Only `enable` switches the torque on, and the first set-point is the servo's own place.
"""

import abc
import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from typing_extensions import override

from hal.device import Check, DeviceState
from hal.drivers.bus_device import BusDevice, Place
from hal.drivers.serial.settings import COUNTS, SerialSettings
from hal.errors import DeviceRefused, DeviceSilent
from hal.line import SerialLine
from hal.protocols.serial_status import Packets, Status

TRIES = 5
"""While a servo is opened, a request is sent at most this number of times."""
RELEASES = 2
"""When a servo is closed, its torque is switched off with this number of packets."""
QUICK_STOP_TIME = 0.3
"""A quick stop holds the servo's place for this time [s] before the torque is switched off."""


class SerialServo(BusDevice[SerialLine]):
    """One servo of a line."""

    IS_SERIAL = True
    COUNTERS = (*BusDevice.COUNTERS, "wrapped")
    packets: ClassVar[Packets]
    feedback: tuple[int, int]
    state: tuple[int, int] | None = None
    torque_register: ClassVar[int]

    @classmethod
    @override
    def commanded(cls, settings: SerialSettings) -> str:
        return str(settings.mode)  # type: ignore[attr-defined]

    @classmethod
    @override
    def traffic(cls, settings: SerialSettings, rate: float) -> tuple[tuple[int, float], ...]:
        """Return bytes and their rate [Hz]: set-point, its place in the request, and the answer."""
        size, overhead = cls.feedback[1], cls.packets.OVERHEAD
        return ((5, rate), (1, rate), (overhead + size, rate))

    def __init__(self, place: Place[SerialLine], settings: SerialSettings) -> None:
        self._settings = settings
        self._mode = self.commanded(settings)
        self.is_changing = False
        self._writes: list[tuple[int, bytes]] = []
        self._position: int | None = None
        self._error = self._latched = 0
        self._is_powered = self._enable_requested = self._enable_succeeded = self._is_wrapped = False
        self._drop_text = ""
        self._braking = 0
        self._hold: int | None = None
        super().__init__(place, settings)

    @abc.abstractmethod
    def _goal(self, value: float) -> list[tuple[int, bytes]]:
        """Return the writes of a set-point [the unit of the commanded quantity]."""

    @abc.abstractmethod
    def _hold_goal(self, counts: int) -> list[tuple[int, bytes]]:
        """Return the writes that keep the servo at a count, or at rest."""

    @abc.abstractmethod
    def _switch_on(self, counts: int) -> list[tuple[int, bytes]]:
        """Return the writes that switch the torque on at a count, in order: limits, goal, torque."""

    @abc.abstractmethod
    def _has_no_watchdog(self) -> str:
        """Return a sentence if the servo does not stop by itself; empty if it does."""

    def _get(self, address: int, size: int) -> bytes:
        """Return registers; may block.

        Raises:
            DeviceSilent: No answer.
        """
        for _ in range(TRIES):
            status = self._bus.request(self.packets.read(self.node, address, size), self.node, size)
            if status is not None:
                self._note(status)
                return status.data
        raise DeviceSilent(
            f"{self._place} does not answer. Is it powered, are its id and the bit rate right, is it a "
            f"{self.packets.NAME} servo?"
        )

    def _integer(self, address: int, size: int) -> int:
        """Return registers as a number without sign; may block.

        Raises:
            DeviceSilent: No answer.
        """
        return int.from_bytes(self._get(address, size), "little")

    def _set(self, address: int, data: bytes, what: str) -> None:
        """Write registers and read them back; may block.

        Raises:
            DeviceSilent: No answer.
            DeviceRefused: The servo keeps another value.
        """
        for _ in range(TRIES):
            self._bus.request(self.packets.write(self.node, address, data), self.node, 0)  # its answer may be off
            if self._get(address, len(data)) == data:
                return
        raise DeviceRefused(f"{self._place} does not take {what} (register {address}). Is its setting locked?")

    def _note(self, status: Status) -> None:
        """Note the error byte of an answer; called in any thread."""

    @override
    def _release(self) -> None:
        self._writes = []
        for _ in range(RELEASES):  # its answer may be switched off
            self._bus.request(self.packets.write(self.node, self.torque_register, b"\0"), self.node, 0)

    def outgoing(self) -> Sequence[tuple[int, bytes]]:
        """Return and forget (address, data) to write in this cycle, in order."""
        writes, self._writes = self._writes, []
        return writes

    def take_state(self, status: Status, received: float) -> None:
        """Handle the answer to the state; called in the line's thread."""

    def _may_store(self) -> bool:
        """Return whether an answer counts; a servo that was silent is commissioned again first."""
        if not self.is_commissioned:
            return False
        if self.missed > self._silent_cycles:
            self._lose(f"{self._place} was silent and answers again, perhaps restarted. It is commissioned again.")
            return False
        return True

    def _store(self, position: int, values: dict[str, float], received: float) -> None:
        """Update the slots; a position that jumped by half a turn is not valid until a reset.

        Args:
            position: Count.
            values: Quantity -> value in its unit; NaN if it is not valid.
            received: Time of arrival [monotonic s].
        """
        before, self._position = self._position, position
        if before is not None and abs(position - before) > COUNTS // 2:
            self._is_wrapped = True
            self._counters["wrapped"] += 1
        slots, store = self._slots, self._values
        for quantity, slot in slots.items():
            store[slot] = values[quantity]
        if self._is_wrapped and "position" in slots:
            store[slots["position"]] = math.nan
        self._received.fill(received)
        self._mark_answered()

    @override
    def _lose(self, text: str) -> None:
        super()._lose(text)
        self._enable_requested = False
        self._position = None

    def _error_text(self, error: int) -> str:
        """Return the causes of an error, as part of a sentence."""
        raise NotImplementedError

    @override
    def _fault(self) -> str:
        if self._is_wrapped:
            return (
                f"{self._place} jumped by more than half a turn between two measurements, so its position is unknown. "
                "Turn it away from the end of its turn, then reset."
            )
        error = self._latched or self._error
        if not error:
            return ""
        return f"{self._place} reports: {self._error_text(error)}. Reset it when the cause is gone."

    @override
    def _drives(self) -> bool:
        return self._is_powered

    @override
    def _running(self) -> tuple[DeviceState, str]:
        self._check_for_drop()
        text = self._drop_text or self._has_no_watchdog()
        return DeviceState.ENABLED if self._is_powered else DeviceState.READY, text

    @override
    def enable(self) -> None:
        self._enable_succeeded = False
        self._braking = 0
        self._drop_text = ""
        self._enable_requested = self.is_changing = True

    @override
    def disable(self) -> None:
        self._enable_requested = False
        self._braking = 0
        self.is_changing = True

    @override
    def quick_stop(self) -> None:
        if self._enable_requested:  # a repeated request does not begin again
            self._braking = round(QUICK_STOP_TIME * self._place.rate)
            self._hold = self._position
        self._enable_requested = False
        self.is_changing = True

    @override
    def reset(self) -> None:
        self._latched = 0
        self._is_wrapped = False

    @override
    def apply(self, values: np.ndarray) -> None:
        if self._latched or self._is_wrapped:
            self._enable_requested = False
        self._check_for_drop()
        if not self._enable_requested or not self.is_commissioned:
            self.idle()
        elif self._is_powered:
            self._enable_succeeded, self.is_changing = True, False
            self._write(self._goal(float(values[0])))
        elif self._position is not None:
            self._write(self._switch_on(self._position))

    @override
    def idle(self) -> None:
        if not self.is_commissioned:
            return
        if not self._is_powered:
            self._braking, self.is_changing = 0, False
        elif self._braking and self._hold is not None:
            self._braking -= 1
            self._write(self._hold_goal(self._hold))
        else:
            self._write([(self.torque_register, b"\0")])

    def _write(self, writes: list[tuple[int, bytes]]) -> None:
        """Replace what waits: only the newest set-point counts."""
        self._writes = writes

    def _check_for_drop(self) -> None:
        if self._enable_requested and self._enable_succeeded and not self._is_powered:
            self._enable_requested = False
            self._drop_text = (
                f"{self._place} switched its torque off by itself. Was it restarted, was its supply interrupted?"
            )

    def _check_bounds(self, lowest: int, highest: int, where: str) -> None:
        """Check that the robot file's limits of the position lie between two counts of the servo.

        Raises:
            DeviceRefused: They do not, so the servo would stop short of a set-point.
        """
        low, high = sorted((self._settings.value(lowest), self._settings.value(highest)))
        least, most = self._place.bounds
        slack = abs(self._settings.per_count)
        if (math.isfinite(least) and least < low - slack) or (math.isfinite(most) and most > high + slack):
            raise DeviceRefused(
                f"{self._place} turns from {low:.4g} to {high:.4g} ({where}), and limits.{self.commands[0]} allows "
                f"{least:.4g} to {most:.4g}. Narrow the limits of the robot file, or widen those of the servo with its "
                "maker's program."
            )

    @override
    def inspect(self) -> tuple[Check, ...]:
        text = self._has_no_watchdog()
        return (Check("watchdog", not text, text or "Set in the servo."),)
