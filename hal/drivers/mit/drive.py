"""A servo drive in MIT mode (T-Motor AK, Damiao DM, mini-cheetah) that turns a joint [rad] or winds a wire [m].

It speaks only when spoken to: in every cycle it is sent a frame; without power that is a request to stay without.
"""

import contextlib
import math
import threading

import can
import numpy as np

from hal.device import Check, DeviceState
from hal.drivers.can_device import CanDevice, Place
from hal.drivers.mit.law import Asked, Law
from hal.drivers.mit.registers import RegisterClient
from hal.drivers.mit.settings import MitSettings
from hal.errors import ConfigError, DeviceRefused, DeviceSilent
from hal.protocols import mit
from hal.protocols.mit import Layout, Register, Special
from hal.wire.bus import Bus, Handler


class Replies:
    """What listens to one identifier, under which each drive of one make says its id in the first byte."""

    def __init__(self, bus: Bus, layout: Layout) -> None:
        self.layout = layout
        self._bus = bus
        self._mask = 0x0F if layout is Layout.DAMIAO else 0xFF
        self._handlers: dict[int, Handler] = {}

    @classmethod
    def join(cls, place: Place, identifier: int, layout: Layout, handler: Handler) -> None:
        """Have `handler` called with the answers of the drive at `place` under `identifier`.

        Raises:
            ConfigError: It can have no such id, or the answers of two devices could not be told apart.
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
                f"Two drives on bus '{bus.name}' answer under {identifier:03X}h with the id {key:X}h, and cannot be "
                "told apart. Give one of them another `master_id` or node."
            )
        replies._handlers[key] = handler

    def __call__(self, data: bytearray, received: float) -> None:
        """Pass a frame on; one of a drive that the robot file does not have is counted as unknown."""
        handler = self._handlers.get(data[0] & self._mask) if data else None
        if handler is None:
            self._bus.counters["unknown"] += 1
        else:
            handler(data, received)


ANSWER_TIMEOUT = 0.05
"""How long [s] an answer may take while the drive is opened."""
TRIES = 4
CONFIRMATIONS = 6
"""After so many answers, one or two a cycle, a drive that does not tell its state is taken to have obeyed."""
QUICK_STOP_TIME = 0.3
"""For so long [s] a quick stop brakes before the power goes."""
CLEARING_CYCLES = 40
"""For so many cycles a fault is tried to be cleared."""
QUANTITIES = ("position", "velocity", "effort", "temperature", "temperature_driver")
_TELLS = {Layout.MINI_CHEETAH: 2, Layout.T_MOTOR: 4, Layout.DAMIAO: 5}
"""How many of these are in an answer; the third of a mini-cheetah is a current or a torque, depending on its flash."""
_POSITION_TOP, _TOP = mit.POSITION_TOP, mit.TOP


class MitDrive(CanDevice):
    """One drive. It is enabled only by `enable`, and stays disabled once it dropped out by itself."""

    Settings = MitSettings
    COUNTERS = (*CanDevice.COUNTERS, "wrapped", "foreign")
    can_damp = True

    @classmethod
    def quantities(cls, settings: MitSettings) -> tuple[str, ...]:
        """See `CanDevice.quantities`; what is commanded comes first."""
        known = QUANTITIES[: _TELLS[settings.actuator[0]]]
        return (settings.mode, *(name for name in known if name != settings.mode))

    @classmethod
    def commanded(cls, settings: MitSettings) -> str:
        """See `CanDevice.commanded`."""
        return settings.mode

    @classmethod
    def traffic(cls, settings: MitSettings, rate: float) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic`."""
        return ((mit.COMMAND_LAYOUT.size, rate), (max(mit.SIZES[settings.actuator[0]]), rate))

    def __init__(self, place: Place, settings: MitSettings) -> None:
        super().__init__(place, settings)
        node = place.node
        self._model = settings.motor
        self._layout, self._ranges = settings.actuator
        self._sizes = mit.SIZES[self._layout]
        self._law = Law(place, settings)
        damiao = self._layout is Layout.DAMIAO
        self._reply_id = settings.master_id if settings.master_id is not None else node + 16 if damiao else 0
        self._places = tuple((slot, QUANTITIES.index(quantity)) for quantity, slot in self._slots.items())
        self._registers = RegisterClient(place, settings.watch_time) if damiao else None
        self._heard = threading.Event()
        self._asked: Special | None = None
        self._confirmations = 0
        self._error = self._latched = 0
        self._counts: tuple[int, int, int] | None = None
        self._is_wrapped = False
        self._is_powered = self._is_wanted = self._was_reached = self._is_watched = self._is_neutral = False
        self._dropped = ""
        self._braking = self._clearing = 0
        self._frame = can.Message(arbitration_id=node, is_extended_id=False, data=bytearray(mit.COMMAND_LAYOUT.size))
        self._specials = {
            code: can.Message(arbitration_id=node, is_extended_id=False, data=mit.special(code))
            for code in (Special.ENTER, Special.EXIT, Special.CLEAR)
        }
        Replies.join(place, self._reply_id, self._layout, self._on_reply)
        if self._reply_id != node:  # nobody may answer under its id either: it would take the answer for a command
            place.bus.subscribe(node, self._on_foreign)

    def _on_foreign(self, data: bytearray, received: float) -> None:
        """Somebody else sends frames to the drive."""
        self._counters["foreign"] += 1

    def _identify(self) -> str:
        if self._reply_id == 0 and self._bus.needs_sync:
            raise DeviceRefused(
                f"{self._place} answers under identifier 0, which CANopen nodes on the same bus take for NMT commands. "
                "Give it another master id, or another bus."
            )
        self._rest()
        self._knock()
        serial = self._registers.read(Register.SERIAL).integer if self._registers else 0
        if 0 < serial < 0xFFFFFFFF:
            return f"damiao:{serial:08x}"
        return f"mit:{self._bus.name}:{self.node}:{self._model}"

    def _knock(self) -> None:
        """Ask to stay without power until there is an answer; may block.

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

    def _commission(self) -> None:
        self._is_wanted = False
        self._counts = None
        for _ in range(CONFIRMATIONS):
            self._knock()
        if self._is_powered:
            raise DeviceRefused(f"{self._place} stays enabled when it is told to power off. Cut its power.")
        if self._registers:
            self._registers.commission(self._ranges)
        self.missed = 0

    def _release(self) -> None:
        self._rest()
        with contextlib.suppress(DeviceSilent, DeviceRefused):  # nothing more can be done for it
            for _ in range(CONFIRMATIONS):
                self._knock()
            if self._registers and not self._is_powered:
                self._registers.release()

    def _on_reply(self, data: bytearray, received: float) -> None:
        if self._registers is not None and self._registers.wanted is not None:
            found = mit.register_answer(data, self.node)
            if found is not None:
                self._registers.take(found)
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
                    self._is_powered = self._asked is Special.ENTER
        if self._error and not self._clearing:
            self._latched = self._error
        if not self._heard.is_set():
            self._heard.set()
        if self.is_commissioned:
            if self.missed > self._silent_cycles:
                self._lose(f"{self._place} was silent and answers again, perhaps restarted. It is commissioned anew.")
            else:
                self._store(mit.counts(data), rotor, driver, received)

    def _store(self, counts: tuple[int, int, int], rotor: float, driver: float, received: float) -> None:
        """Bring the slots up to date; a value at the end of its range may be anything beyond, and is NaN."""
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
        self._is_answered()

    def _lose(self, text: str) -> None:
        super()._lose(text)
        self._is_wanted = False

    def _fault(self) -> str:
        if self._is_wrapped:
            return (
                f"{self._place} turned beyond {self._ranges.position:g} rad, where its position starts again at the "
                "other end, so its place is not known. Turn it back, restart the drive, then reset."
            )
        error = self._latched or self._error
        if not error:
            return ""
        told = mit.describe_error(error, self._layout)
        return f"{self._place} reports {told}. Reset it when the cause is gone; if it stays, cut its power once."

    def _drives(self) -> bool:
        return self._is_powered

    def _running(self) -> tuple[DeviceState, str]:
        self._look_for_drop()
        text = self._dropped
        if not text and self._registers is None:
            text = f"{self._place} has no watchdog: should the HAL die while it is enabled, it keeps to its last frame."
        return DeviceState.ENABLED if self._is_powered else DeviceState.READY, text

    def enable(self) -> None:
        """See `Device.enable`; the stiffness grows from 0 within `ramp`, about the first set-point."""
        self._is_watched = self._is_neutral = self._was_reached = False
        self._braking = 0
        self._dropped = ""
        self._law.restart()
        if self._registers:
            self._registers.found = None
        self._is_wanted = True

    def disable(self) -> None:
        """See `Device.disable`."""
        self._is_wanted = False
        self._braking = 0

    def quick_stop(self) -> None:
        """See `Device.quick_stop`: damping alone for `QUICK_STOP_TIME`, then no power."""
        self._is_wanted = False
        self._braking = round(QUICK_STOP_TIME * self._place.rate) if self._is_powered else 0

    def reset(self) -> None:
        """See `Device.reset`."""
        self._latched = 0
        self._is_wrapped = False
        self._clearing = CLEARING_CYCLES

    def apply(self, values: np.ndarray) -> None:
        """See `Device.apply`; until the drive has power it is asked to power on, with no torque."""
        if self._may_move():
            self._command(self._law.set_point(float(values[0]), self._counts))

    def damp(self) -> None:
        """See `Device.damp`."""
        if self._may_move():
            self._command(self._law.braking())

    def idle(self) -> None:
        """See `Device.idle`; the drive is asked to stay without power, and answers where it is."""
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
        """Ask to forget a fault; T-Motor has no frame for that but to be entered, which here lasts two frames."""
        self._clearing -= 1
        if self._layout is Layout.DAMIAO:
            self._bus.send(self._specials[Special.CLEAR])
        else:
            self._bus.send(self._specials[Special.ENTER])
            self._rest()
            self._ask(Special.EXIT)

    def _may_move(self) -> bool:
        """Whether the drive has power and may be sent a set-point; if not, it was sent what it needs in this cycle."""
        if self._latched or self._is_wrapped:
            self._is_wanted = False
        self._look_for_drop()
        if not self._is_wanted or not self.is_commissioned:
            self.idle()
        elif self._is_powered and self._asked is Special.ENTER:
            self._was_reached = True
            return True
        else:
            self._power_on()
        return False

    def _look_for_drop(self) -> None:
        if self._is_wanted and self._was_reached and not self._is_powered:
            self._is_wanted = False
            self._dropped = f"{self._place} powered off by itself. Was it restarted, was its supply interrupted?"

    def _power_on(self) -> None:
        """One step: look at its watchdog, take back what it was told before, then ask it for power without torque."""
        if self._registers and not self._is_watched:
            watching = self._registers.is_watching
            if watching is None:
                self._registers.ask(Register.TIMEOUT)
                self._rest()
                return
            if not watching:
                self._lose(f"{self._place} forgot its watchdog, so it was restarted, and waits to be commissioned.")
                return
            self._is_watched = True
        if self._is_neutral:
            self._ask(Special.ENTER)
        self._rest()

    def _rest(self) -> None:
        """No torque: the last frame before the power goes and the first after it came, as some follow their last again.

        Seen of T-Motor: github.com/dfki-ric-underactuated-lab/mini-cheetah-tmotor-python-can at 0ef9f89,
        src/motor_driver/canmotorlib.py, comments in `enable_motor` and `disable_motor`.
        """
        self._command(self._law.resting(self._counts))
        self._is_neutral = True

    def _command(self, asked: Asked) -> None:
        self._is_neutral = False
        mit.COMMAND_LAYOUT.pack_into(self._frame.data, 0, mit.pack(*asked, self._ranges))
        self._bus.send(self._frame)

    def _ask(self, code: Special) -> None:
        if code is not self._asked:
            self._asked, self._confirmations = code, CONFIRMATIONS
        self._bus.send(self._specials[code])

    def inspect(self) -> tuple[Check, ...]:
        """See `Device.inspect`."""
        self._knock()
        if self._registers is not None:
            return self._registers.inspect(self._ranges)
        return (
            Check("watchdog", False, "It has none that can be set or read over CAN. Have its power cut otherwise."),
            Check("ranges", True, "They cannot be read over CAN. Compare them with the manual of this firmware."),
        )
