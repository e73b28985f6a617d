"""A servo drive in MIT mode (T-Motor AK, Damiao DM, mini-cheetah) that turns a joint [rad] or winds a wire [m].

The drive only answers frames, so it is sent one in every cycle. Without power this frame is a request to stay so.
"""

import contextlib
import math
import threading

import can
import numpy as np
from typing_extensions import override

from hal.calibration.units import axis_units
from hal.device import Check, DeviceState
from hal.drivers.can_device import CanDevice, Place
from hal.drivers.mit.law import Law
from hal.drivers.mit.registers import RegisterClient
from hal.drivers.mit.settings import MitSettings
from hal.errors import ConfigError, DeviceRefused, DeviceSilent
from hal.protocols import mit
from hal.protocols.mit import Command, Layout, Register, Special
from hal.wire.bus import Bus, Handler


class Replies:
    """The receiver of one identifier, under which each drive of one make sends its id in the first byte."""

    def __init__(self, bus: Bus, layout: Layout) -> None:
        self.layout = layout
        self._bus = bus
        self._mask = 0x0F if layout is Layout.DAMIAO else 0xFF
        self._handlers: dict[int, Handler] = {}

    @classmethod
    def join(cls, place: Place, identifier: int, layout: Layout, handler: Handler) -> None:
        """Call `handler` with the answers of the drive at `place` under `identifier`.

        Raises:
            ConfigError: The id is out of range, or the answers of two devices cannot be distinguished.
        """
        highest = 0xFF if layout is Layout.T_MOTOR else mit.NODES - 1
        if not 1 <= place.node <= highest:
            raise ConfigError(f"{place}: the id of such a drive is between 1 and {highest}.")
        bus = place.bus
        replies = bus.subscriber(identifier)
        if not isinstance(replies, cls) or replies.layout is not layout:
            replies = cls(bus, layout)
            bus.subscribe(identifier, replies)
        key = place.node & replies._mask
        if key in replies._handlers:
            raise ConfigError(
                f"Two drives on bus '{bus.name}' answer under {identifier:03X}h with the id {key:X}h, so their answers "
                "cannot be distinguished. Give one of them another `master_id` or node."
            )
        replies._handlers[key] = handler

    def __call__(self, data: bytearray, received: float) -> None:
        """Pass a frame on; count it as unknown if the robot file does not have its drive."""
        handler = self._handlers.get(data[0] & self._mask) if data else None
        if handler is None:
            self._bus.counters["unknown"] += 1
        else:
            handler(data, received)


ANSWER_TIMEOUT = 0.05
"""While the drive is opened, a request is repeated after this time [s]."""
TRIES = 4
CONFIRMATIONS = 6
"""A drive that does not report its state counts as switched after this number of answers, one or two per cycle."""
QUICK_STOP_TIME = 0.3
"""A quick stop brakes for this time [s] before it powers off."""
CLEARING_CYCLES = 40
"""`reset` tries to clear a fault for this number of cycles."""
QUANTITIES = ("position", "velocity", "effort", "temperature", "temperature_driver")
_REPORTED = {Layout.MINI_CHEETAH: 2, Layout.T_MOTOR: 4, Layout.DAMIAO: 5}
"""An answer has this number of `QUANTITIES`. The third value of a mini-cheetah is not used, because the settings in its
flash decide whether it is a current or a torque."""
_POSITION_TOP, _TOP = mit.POSITION_TOP, mit.TOP


class MitDrive(CanDevice):
    """One drive. Only `enable` enables it; a drive that powers off by itself stays disabled."""

    Settings = MitSettings
    COUNTERS = (*CanDevice.COUNTERS, "wrapped", "foreign")
    can_damp = True

    @classmethod
    @override
    def quantities(cls, settings: MitSettings) -> tuple[str, ...]:
        reported = QUANTITIES[: _REPORTED[settings.actuator[0]]]
        return (settings.mode, *(name for name in reported if name != settings.mode))

    @classmethod
    @override
    def commanded(cls, settings: MitSettings) -> str:
        return settings.mode

    @classmethod
    @override
    def unit_of(cls, settings: MitSettings, quantity: str) -> str | None:
        return axis_units(settings.spool_radius is not None).get(quantity)

    @classmethod
    @override
    def traffic(cls, settings: MitSettings, rate: float) -> tuple[tuple[int, float], ...]:
        return ((mit.COMMAND_LAYOUT.size, rate), (max(mit.SIZES[settings.actuator[0]]), rate))

    def __init__(self, place: Place, settings: MitSettings) -> None:
        super().__init__(place, settings)
        node = place.node
        self._model = settings.motor
        self._layout, self._ranges = settings.actuator
        self.fastest = self._ranges.velocity * abs(settings.scale)
        self._sizes = mit.SIZES[self._layout]
        self._law = Law(place, settings)
        self.compliance = self._law.compliance
        damiao = self._layout is Layout.DAMIAO
        self._reply_id = settings.master_id if settings.master_id is not None else node + 16 if damiao else 0
        self._places = tuple((slot, QUANTITIES.index(quantity)) for quantity, slot in self._slots.items())
        self._registers = RegisterClient(place, settings.watch_time) if damiao else None
        self._heard = threading.Event()
        self._request: Special | None = None
        self._confirmations = 0
        self._error = self._latched = 0
        self._counts: tuple[int, int, int] | None = None
        self._is_wrapped = False
        self._is_powered = self._enable_requested = self._enable_succeeded = self._is_watched = self._is_neutral = False
        self._drop_text = ""
        self._braking = self._clearing = 0
        self._frame = can.Message(arbitration_id=node, is_extended_id=False, data=bytearray(mit.COMMAND_LAYOUT.size))
        self._specials = {
            code: can.Message(arbitration_id=node, is_extended_id=False, data=mit.special(code))
            for code in (Special.ENTER, Special.EXIT, Special.CLEAR)
        }
        Replies.join(place, self._reply_id, self._layout, self._on_reply)
        if self._reply_id != node:  # reserves the id: the drive would take an answer under it for a command
            place.bus.subscribe(node, self._on_foreign)

    def _on_foreign(self, data: bytearray, received: float) -> None:
        """Count a frame that another sender sent to the drive."""
        self._counters["foreign"] += 1

    @override
    def _identify(self) -> str:
        if self._reply_id == 0 and self._bus.needs_sync:
            raise DeviceRefused(
                f"{self._place} answers under identifier 0, where CANopen nodes on the same bus expect NMT commands. "
                "Give it another master id, or another bus."
            )
        self._rest()
        self._knock()
        serial = self._registers.read(Register.SERIAL).integer if self._registers else 0
        if 0 < serial < 0xFFFFFFFF:
            return f"damiao:{serial:08x}"
        return f"mit:{self._bus.name}:{self.node}:{self._model}"

    def _knock(self) -> None:
        """Request power off until the drive answers; may block.

        Raises:
            DeviceSilent: No answer.
        """
        for _ in range(TRIES):
            self._heard.clear()
            self._ask(Special.EXIT)
            if self._heard.wait(ANSWER_TIMEOUT):
                return
        raise DeviceSilent(
            f"{self._place} does not answer under {self._reply_id:03X}h. Is it powered, are its id and master id right?"
        )

    @override
    def _commission(self) -> None:
        self._enable_requested = False
        self._counts = None
        for _ in range(CONFIRMATIONS):
            self._knock()
        if self._is_powered:
            raise DeviceRefused(f"{self._place} stays enabled after the command to power off. Cut its power.")
        if self._registers:
            self._registers.commission(self._ranges)
        self.missed = 0

    @override
    def _release(self) -> None:
        self._rest()
        with contextlib.suppress(DeviceSilent, DeviceRefused):
            for _ in range(CONFIRMATIONS):
                self._knock()
            if self._registers and not self._is_powered:
                self._registers.release()

    def _on_reply(self, data: bytearray, received: float) -> None:
        if self._registers is not None and self._registers.pending is not None:
            answer = mit.parse_register(data, self.node)
            if answer is not None:
                self._registers.take(answer)
                return
        if len(data) not in self._sizes:
            self._counters["malformed"] += 1
            return
        rotor = driver = math.nan
        if self._registers is not None:
            state, rotor, driver = data[0] >> 4, data[7], data[6]
            self._is_powered = state == mit.ENABLED
            self._error = state if state > mit.ENABLED else 0
        else:
            if len(data) == 8:
                rotor, self._error = data[6] + mit.T_MOTOR_COLDEST, data[7]
            if self._confirmations:
                self._confirmations -= 1
                if not self._confirmations:
                    self._is_powered = self._request is Special.ENTER
        if self._error and not self._clearing:
            self._latched = self._error
        if not self._heard.is_set():
            self._heard.set()
        if self.is_commissioned:
            if self.missed > self._silent_cycles:
                self._lose(f"{self._place} was silent and answers again, perhaps restarted. It is commissioned again.")
            else:
                self._store(mit.counts(data), rotor, driver, received)

    def _store(self, counts: tuple[int, int, int], rotor: float, driver: float, received: float) -> None:
        """Update the slots; a value at the end of its range is NaN, because it may lie beyond."""
        position, velocity, effort = counts
        before, self._counts = self._counts, counts
        if before is not None and abs(position - before[0]) > _POSITION_TOP // 2:
            self._is_wrapped = True
            self._counters["wrapped"] += 1
        lines = self._law.lines
        measured = (
            lines[0][0] * position + lines[0][1] if 0 < position < _POSITION_TOP and not self._is_wrapped else math.nan,
            lines[1][0] * velocity + lines[1][1] if 0 < velocity < _TOP else math.nan,
            lines[2][0] * effort + lines[2][1] if 0 < effort < _TOP else math.nan,
            rotor,
            driver,
        )
        values = self._values
        for slot, index in self._places:
            values[slot] = measured[index]
        self._received.fill(received)
        self._mark_answered()

    @override
    def _lose(self, text: str) -> None:
        super()._lose(text)
        self._enable_requested = False

    @override
    def _fault(self) -> str:
        if self._is_wrapped:
            return (
                f"{self._place} turned beyond {self._ranges.position:g} rad, where its measurement jumps to the other "
                "end, so its position is unknown. Turn it back, restart the drive, then reset."
            )
        error = self._latched or self._error
        if not error:
            return ""
        text = mit.describe_error(error, self._layout)
        return f"{self._place} reports {text}. Reset it when the cause is gone; if it stays, cut its power once."

    @override
    def _drives(self) -> bool:
        return self._is_powered

    @override
    def _running(self) -> tuple[DeviceState, str]:
        self._check_for_drop()
        text = self._drop_text
        if not text and self._registers is None:
            text = f"{self._place} has no watchdog: if the HAL dies while it is enabled, it follows its last frame."
        return DeviceState.ENABLED if self._is_powered else DeviceState.READY, text

    @override
    def enable(self) -> None:
        self._is_watched = self._is_neutral = self._enable_succeeded = False
        self._braking = 0
        self._drop_text = ""
        self._law.restart()
        if self._registers:
            self._registers.answer = None
        self._enable_requested = True

    @override
    def disable(self) -> None:
        self._enable_requested = False
        self._braking = 0

    @override
    def quick_stop(self) -> None:
        self._enable_requested = False
        self._braking = round(QUICK_STOP_TIME * self._place.rate) if self._is_powered else 0

    @override
    def reset(self) -> None:
        self._latched = 0
        self._is_wrapped = False
        self._clearing = CLEARING_CYCLES

    @override
    def apply(self, values: np.ndarray) -> None:
        if self._may_move():
            self._command(self._law.set_point(float(values[0]), self._counts))

    @override
    def damp(self) -> None:
        if self._may_move():
            self._command(self._law.braking())

    @override
    def idle(self) -> None:
        if not self.is_commissioned:
            return
        if self._is_powered and self._braking:
            self._braking -= 1
            self._command(self._law.braking())
        elif self._is_powered and not self._is_neutral:
            self._rest()
        elif self._clearing and self._error:
            self._clear()
        else:
            self._clearing = 0
            self._ask(Special.EXIT)

    def _clear(self) -> None:
        """Request that a fault is cleared; for T-Motor by powering on for two frames, as it has no frame for this."""
        self._clearing -= 1
        if self._layout is Layout.DAMIAO:
            self._bus.send(self._specials[Special.CLEAR])
        else:
            self._bus.send(self._specials[Special.ENTER])
            self._rest()
            self._ask(Special.EXIT)

    def _may_move(self) -> bool:
        """Return whether the drive is enabled and takes a set-point; if not, send the frame of this cycle instead."""
        if self._latched or self._is_wrapped:
            self._enable_requested = False
        self._check_for_drop()
        if not self._enable_requested or not self.is_commissioned:
            self.idle()
        elif self._is_powered and self._request is Special.ENTER:
            self._enable_succeeded = True
            return True
        else:
            self._power_on()
        return False

    def _check_for_drop(self) -> None:
        if self._enable_requested and self._enable_succeeded and not self._is_powered:
            self._enable_requested = False
            self._drop_text = f"{self._place} powered off by itself. Was it restarted, was its supply interrupted?"

    def _power_on(self) -> None:
        """Do one step: read the watchdog, send a command without torque, then request power."""
        if self._registers and not self._is_watched:
            watching = self._registers.is_watching
            if watching is None:
                self._registers.ask(Register.TIMEOUT)
                self._rest()
                return
            if not watching:
                self._lose(f"{self._place} lost its watchdog setting, so it was restarted; it is commissioned again.")
                return
            self._is_watched = True
        if self._is_neutral:
            self._ask(Special.ENTER)
        self._rest()

    def _rest(self) -> None:
        """Command no torque: in the last frame before power off and in the first one after power on, because some
        drives follow the last command again when they power on.

        Source for T-Motor: github.com/dfki-ric-underactuated-lab/mini-cheetah-tmotor-python-can at 0ef9f89,
        src/motor_driver/canmotorlib.py, comments in `enable_motor` and `disable_motor`.
        """
        self._command(self._law.resting(self._counts))
        self._is_neutral = True

    def _command(self, command: Command) -> None:
        self._is_neutral = False
        mit.COMMAND_LAYOUT.pack_into(self._frame.data, 0, mit.pack(command, self._ranges))
        self._bus.send(self._frame)

    def _ask(self, code: Special) -> None:
        if code is not self._request:
            self._request, self._confirmations = code, CONFIRMATIONS
        self._bus.send(self._specials[code])

    @override
    def inspect(self) -> tuple[Check, ...]:
        self._knock()
        if self._registers is not None:
            return self._registers.inspect(self._ranges)
        return (
            Check("watchdog", False, "It has none that can be set or read over CAN. Cut its power by other means."),
            Check("ranges", True, "They cannot be read over CAN. Compare them with the manual of this firmware."),
        )
