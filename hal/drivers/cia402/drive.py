"""A servo drive that winds a wire [m] or turns a joint [rad]: position, velocity or effort control over CiA 402."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
from typing_extensions import override

from hal.calibration.units import axis_units
from hal.commissioning.node import cob_id
from hal.commissioning.pdo_map import Pdo, describe
from hal.commissioning.sdo_client import SdoClient
from hal.device import Check, DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen.node import HEARTBEAT, CanopenNode, PdoHandler, data_sheet
from hal.drivers.cia402.modes import HomingRun, SetPointHandshake
from hal.drivers.cia402.settings import MODES, OBJECTS, DriveSettings, DriveUnits, drive_units
from hal.drivers.cia402.writes import Write, check_objects, drive_writes
from hal.errors import CommandRefused, ConfigError, DeviceRefused
from hal.protocols import cia301, cia402
from hal.protocols.cia301 import MappedObject
from hal.protocols.cia402 import OperationMode, State, VelocityUnit
from hal.wire.bus import Bus

UNWATCHED = "{} does not detect the loss of the HAL (no 1016h)."


def drive_checks(sdo: SdoClient, mode: OperationMode, is_watched: bool, label: str) -> Iterator[Check]:
    """Check the mode of the drive, and yield failed checks for objects that its data sheet lacks.

    Args:
        sdo: Client of the drive.
        mode: The expected mode.
        is_watched: Whether the drive detects the loss of the HAL.
        label: Name of the drive in messages.

    Raises:
        DeviceSilent: It does not answer.
    """
    if not is_watched:
        yield Check("watchdog", False, f"{UNWATCHED.format(label)} Cut its power by other means.")
    if not sdo.has(cia402.ABORT_CONNECTION.index):
        text = "There is no object 6007h. Check in the manual how the drive reacts when the heartbeat fails."
        yield Check("abort option", False, text)
    if sdo.has(cia402.MODE_DISPLAY.index):
        actual = sdo.read_signed(cia402.MODE_DISPLAY.index, 0, cia402.MODE_DISPLAY.bits)
        text = f"The drive is in mode {cia402.describe_mode(actual)}."
        is_good = actual == mode
        yield Check("mode", is_good, text if is_good else f"{text} Open it again, or check its display.")


class CommandFrames:
    """The RPDOs with controlword, mode and target."""

    def __init__(self, pdos: Sequence[Pdo], node: int, target: MappedObject, label: str) -> None:
        """Prepare the frames.

        Args:
            pdos: The RPDOs.
            node: Node id.
            target: The object of the set-point.
            label: Name of the drive in messages.

        Raises:
            ConfigError: They carry an object without a value here.
        """
        known = (cia402.CONTROLWORD, cia402.MODE_OF_OPERATION, target)
        unknown = [item for pdo in pdos for item in pdo.objects if item not in known]
        if unknown:
            raise ConfigError(
                f"{label}: pdo.receives has {describe(unknown)}, which would be sent as 0. "
                f"In this mode it may have {describe(known)}."
            )
        self._frames = []
        for pdo in pdos:
            identifier = cob_id(cia301.RPDO1, pdo.number, node)
            message = can.Message(arbitration_id=identifier, is_extended_id=False, data=bytearray(pdo.size))
            places = tuple(known.index(item) for item in pdo.objects)
            self._frames.append((message, pdo.layout, places))

    def send(self, bus: Bus, word: int, mode: int, target: int) -> None:
        """Send them from the cycle's thread, which reuses the same frames."""
        values = (word, mode, target)
        for message, layout, places in self._frames:
            layout.pack_into(message.data, 0, *[values[place] for place in places])
            bus.send(message)

    def send_new(self, bus: Bus, word: int, mode: int, target: int) -> None:
        """Send them from any thread, in new frames."""
        values = (word, mode, target)
        for message, layout, places in self._frames:
            data = layout.pack(*[values[place] for place in places])
            bus.send(can.Message(arbitration_id=message.arbitration_id, is_extended_id=False, data=data))


RESET_CYCLES = 200
"""A fault reset is tried for this number of cycles."""
RESET_PERIOD = 4
"""A fault reset has one rising edge in this number of cycles."""
RESETTABLE = (State.FAULT, State.FAULT_REACTION, State.NOT_READY)
"""A fault reset goes on in these states; a drive that was lost is in the last one until its first statusword."""
STOPPING = 0.8
"""After this time [s] for a quick stop, or for slowing down, the drive is powered off."""
RAMPED = (OperationMode.PROFILE_POSITION, OperationMode.CYCLIC_SYNCHRONOUS_VELOCITY)
"""In these modes a drive may move when it is disabled, so it slows down first."""
ANSWER_TIME = 1.0
"""`health` warns if a drive takes longer than this time [s] to acknowledge a set-point."""


class Cia402Drive(CanopenNode):
    """One drive. Only `enable` enables it; a drive that leaves 'operation enabled' by itself stays disabled."""

    Settings = DriveSettings
    COUNTERS = (*CanopenNode.COUNTERS, "homed")
    MAY_RECEIVE = (cia402.MODE_OF_OPERATION,)

    @classmethod
    @override
    def quantities(cls, settings: DriveSettings) -> tuple[str, ...]:
        return settings.quantities

    @classmethod
    @override
    def commanded(cls, settings: DriveSettings) -> str:
        return settings.commanded

    @classmethod
    @override
    def unit_of(cls, settings: DriveSettings, quantity: str) -> str | None:
        return axis_units(settings.spool_radius is not None).get(quantity)

    @classmethod
    @override
    def traffic_of(
        cls, settings: DriveSettings, rate: float, quantities: tuple[str, ...], folder: Path
    ) -> tuple[tuple[int, float], ...]:
        pdos = settings.pdo.map("pdo") if settings.pdo else settings.pdos(quantities)
        return (*pdos.frames(rate), HEARTBEAT)

    def __init__(self, place: Place, settings: DriveSettings) -> None:
        self._settings = settings
        self._sheet = data_sheet(place.folder / settings.eds)
        self._units: DriveUnits | None = None
        self._state = State.NOT_READY
        self._statusword = -1
        """The newest statusword; -1 before the first."""
        self._counts: int | None = None
        self._actual_mode = 0
        self._velocity = math.nan
        count = len(place.elements)
        self._zeros, self._scales = np.zeros(count).tolist(), np.full(count, math.nan).tolist()
        super().__init__(place, settings, cia402.PROFILE, settings.pdos(tuple(place.elements)))
        check_objects(settings, "effort" in place.elements, self._sheet, str(place))
        self.can_damp = settings.damping is not None
        self.fastest = settings.max_velocity or math.inf
        self._mode = MODES[settings.mode]
        self._is_watched = self._sdo.has(cia301.CONSUMER_HEARTBEAT, 1)
        self._handshake = SetPointHandshake()
        self._homing: HomingRun | None = None
        self._enable_requested = False
        self._enable_succeeded = False
        self._text = ""
        self._resetting = self._quick_stopping = self._slowing = 0
        self._stopping_cycles = round(STOPPING * place.rate)
        self._frames = CommandFrames(self._pdos.receives, place.node, settings.target, str(place))

    @override
    def _watch_time(self) -> float:
        return self._settings.watch_time if self._is_watched else 0.0

    @override
    def _before_commissioning(self) -> None:
        self._forget()
        self._sdo.write(cia402.CONTROLWORD.index, 0, cia402.DISABLE_VOLTAGE, 2)

    @override
    def _calibrate(self) -> None:
        self._check_modes()
        settings = self._settings
        units = self._units = drive_units(settings, self._velocity_unit(), self._rated_torque())
        line = units.position
        lines = {
            "position": (line.zero, line.scale),
            "velocity": (0.0, units.velocity),
            "effort": (0.0, units.effort),
            "following_error": (0.0, line.scale),
        }
        if settings.temperature:
            lines["temperature"] = (settings.temperature.zero, settings.temperature.scale)
        for quantity, slot in self._slots.items():
            self._zeros[slot], self._scales[slot] = lines[quantity]

    def _check_modes(self) -> None:
        if not self._sdo.has(cia402.SUPPORTED_MODES.index):
            return
        modes = self._sdo.read(cia402.SUPPORTED_MODES.index, 0)
        for mode in (self._mode, *((OperationMode.HOMING,) if self._settings.homing else ())):
            if not cia402.supports(modes, mode):
                raise DeviceRefused(
                    f"{self._place} does not have the mode {cia402.describe_mode(mode)}. By its object 6502h it has "
                    f"{cia402.describe_modes(modes)}."
                )

    def _velocity_unit(self) -> VelocityUnit:
        name = self._settings.velocity_unit
        if name is None and self._sdo.has(cia402.VELOCITY_UNIT.index):
            code = self._sdo.read_twice(cia402.VELOCITY_UNIT.index, 0)
            unit = cia402.velocity_unit(code)
            if unit is not None:
                return unit
            if code:
                known = ", ".join(cia402.VELOCITY_UNITS)
                raise DeviceRefused(
                    f"{self._place} has velocities in the unknown unit {code:08X}h (60A9h). "
                    f"Give velocity_unit: {known}."
                )
        return cia402.VELOCITY_UNITS[name or "counts/s"]

    def _rated_torque(self) -> float:
        """Return the rated torque [N m]; NaN if effort is not measured."""
        if self._settings.rated_torque is not None:
            return self._settings.rated_torque
        if "effort" not in self._slots:
            return math.nan
        torque = self._sdo.read_twice(cia402.RATED_TORQUE.index, 0) * 1e-3
        if not torque:
            raise DeviceRefused(f"{self._place} reports a rated torque of 0 (6076h). Give rated_torque.")
        return torque

    @override
    def _writes(self) -> tuple[Write, ...]:
        assert self._units is not None
        return drive_writes(self._settings, self._units, self._place.bounds, 1.0 / self._place.rate, self._sheet)

    @override
    def _pdo_handler(self, pdo: Pdo) -> PdoHandler:
        places = {item: place for place, item in enumerate(pdo.objects)}
        status, counts, velocity, mode = (
            places.get(item, -1) for item in (cia402.STATUSWORD, cia402.POSITION, cia402.VELOCITY, cia402.MODE_DISPLAY)
        )
        objects = OBJECTS | ({"temperature": self._settings.temperature.mapped} if self._settings.temperature else {})
        kept = [(places[objects[q]], slot) for q, slot in self._slots.items() if objects[q] in places]
        zeros, scales, measured, times = self._zeros, self._scales, self._values, self._received

        def take(values: tuple[Any, ...], received: float) -> None:
            if status >= 0:
                self._statusword = word = values[status]
                self._state = cia402.STATE_OF[word & 0x6F]
            if counts >= 0:
                self._counts = values[counts]
            if velocity >= 0:
                self._velocity = values[velocity]
            if mode >= 0:
                self._actual_mode = values[mode]
            for place, slot in kept:
                measured[slot] = zeros[slot] + scales[slot] * values[place]
                times[slot] = received

        return take

    @override
    def _lose(self, text: str) -> None:
        super()._lose(text)
        self._forget()

    def _forget(self) -> None:
        """Drop the state of the drive and all requests."""
        self._state, self._statusword, self._counts = State.NOT_READY, -1, None
        self._enable_requested, self._quick_stopping, self._slowing, self._homing = False, 0, 0, None

    @override
    def _drives(self) -> bool:
        return self._state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION)

    @override
    def _running(self) -> tuple[DeviceState, str]:
        state, homing = self._state, self._homing
        if state is State.FAULT or state is State.FAULT_REACTION:
            return DeviceState.FAULT, f"{self._place} is in its state '{state}'. Check its display, then reset."
        if homing is not None:
            return DeviceState.HOMING, f"{self._place} is {homing.phase}."
        if state is State.OPERATION_ENABLED:
            return DeviceState.ENABLED, self._warning()
        if state is State.QUICK_STOP_ACTIVE:
            return DeviceState.STOPPING, self._text or f"{self._place} comes to rest by a quick stop."
        return DeviceState.READY, self._text or self._warning()

    def _warning(self) -> str:
        if self._handshake.waited > ANSWER_TIME * self._place.rate:
            return f"{self._place} does not acknowledge set-points (bit 12 of its statusword)."
        if self._statusword >= 0 and not self._statusword & cia402.REMOTE:
            return f"{self._place} is controlled from its own panel and takes no commands (bit 9 of its statusword)."
        if self._statusword >= 0 and self._statusword & cia402.WARNING:
            return f"{self._place} warns (bit 7 of its statusword). Check its display."
        return "" if self._is_watched else UNWATCHED.format(self._place)

    @override
    def enable(self) -> None:
        self._enable_requested, self._enable_succeeded, self._text, self._quick_stopping = True, False, "", 0

    @override
    def disable(self) -> None:
        if self._enable_requested and self._mode in RAMPED:
            self._slowing = self._stopping_cycles
        self._enable_requested = False
        if (homing := self._homing) is not None:
            homing.give_up("was stopped")

    @override
    def quick_stop(self) -> None:
        self.disable()
        if self._state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE):
            self._quick_stopping = self._stopping_cycles  # the command goes out now, and then in every cycle
            self._frames.send_new(self._bus, cia402.QUICK_STOP, self._homing_mode(), self._rest())

    @override
    def home(self) -> None:
        if self._settings.homing is None:
            raise CommandRefused(f"'{self.name}' has no setting `homing` in the robot file.")
        health = self.health()
        if health.state is not DeviceState.READY:
            raise CommandRefused(f"'{self.name}' is {health.state}, not ready, so it cannot be homed. {health.text}")
        self._text = ""
        self._homing = HomingRun(self._mode, round(self._settings.homing.timeout * self._place.rate))

    @override
    def reset(self) -> None:
        super().reset()
        self._text = ""
        self._resetting = RESET_CYCLES

    @override
    def apply(self, values: np.ndarray) -> None:
        # Before the drive is enabled its target is 0 for a velocity or torque. For a position it is already the value
        # that `Robot` has checked, so that a single wrong frame cannot become the position to start from.
        units = self._units
        if units is None:
            return
        convert = {"position": units.counts, "velocity": units.speed, "effort": units.torque}[self.command_quantity]
        target = convert(float(values[0]))
        if not self._leads_to_enabled(target if self.command_quantity == "position" else 0):
            return
        bits = 0
        if self._mode is OperationMode.PROFILE_POSITION:
            bits, target = self._handshake.step(target, self._statusword)
        elif self._mode is OperationMode.INTERPOLATED_POSITION:
            bits = cia402.INTERPOLATE
        self._send(cia402.ENABLE_OPERATION | bits, target, self._mode)

    @override
    def damp(self) -> None:
        if not self._leads_to_enabled(self._rest()) or self._units is None or self._settings.damping is None:
            return
        effort = -self._settings.damping * self._velocity * self._units.velocity
        self._send(cia402.ENABLE_OPERATION, self._units.torque(effort) if effort == effort else 0, self._mode)

    @override
    def idle(self) -> None:
        state = self._state
        if self._quick_stopping:
            self._quick_stopping -= 1
            if state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE):
                word = cia402.QUICK_STOP if self._quick_stopping else cia402.DISABLE_VOLTAGE
                self._send(word, self._rest(), self._homing_mode())
                return
            self._quick_stopping = 0
        homing = self._homing
        if homing is not None:
            word, mode = homing.step(state, self._statusword, self._actual_mode)
            self._send(word, self._rest(), mode)
            if homing.is_over:
                self._end_homing(homing)
            return
        self._slowing = max(self._slowing - 1, 0) if state is State.OPERATION_ENABLED else 0
        word = cia402.towards_disabled(state, slow_down=self._slowing > 0)
        if self._resetting:
            if state is State.FAULT and self._resetting % RESET_PERIOD == 0:
                word = cia402.FAULT_RESET
            self._resetting = self._resetting - 1 if state in RESETTABLE else 0
        self._send(word, self._rest(), self._mode)

    @override
    def inspect(self) -> tuple[Check, ...]:
        if self._units is None:  # not opened yet
            self._calibrate()
        checks = drive_checks(self._sdo, self._mode, self._is_watched, str(self._place))
        self.fastest = self._motor_speed()
        return (*super().inspect(), *checks)

    def _motor_speed(self) -> float:
        """Return the highest speed of the motor (6080h) at the output [unit/s]; infinite if the drive has none."""
        known = self._settings.max_velocity or math.inf
        if self._units is None or not self._sdo.has(cia402.MAX_MOTOR_SPEED.index):
            return known
        try:
            turns = self._sdo.read(cia402.MAX_MOTOR_SPEED.index, 0)
        except DeviceRefused:  # some data sheets list objects that the drive does not have
            return known
        return turns / 60.0 * self._units.motor_turn if turns else known

    def _leads_to_enabled(self, rest: int) -> bool:
        """Return whether the drive takes set-points; if not, send the command of this cycle instead.

        It leads the drive towards 'operation enabled', or disables it if it left that state by itself.

        Args:
            rest: Target that does not move the drive.
        """
        state = self._state
        if self._enable_requested and self._enable_succeeded and state is not State.OPERATION_ENABLED:
            self._enable_requested = False
            self._text = f"{self._place} left 'operation enabled' by itself and is '{state}'."
        if not self._enable_requested:
            self.idle()
            return False
        if state is not State.OPERATION_ENABLED:
            self._send(cia402.towards_enabled(state), rest, self._mode)
            return False
        if not self._enable_succeeded:
            self._enable_succeeded = True
            self._handshake.start(rest)
        return True

    def _end_homing(self, homing: HomingRun) -> None:
        self._homing = None
        self._text = f"{self._place}: homing {homing.problem}." if homing.problem else ""
        if not homing.problem:
            self._counters["homed"] += 1
            self.origin += 1

    def _homing_mode(self) -> OperationMode:
        return self._mode if self._homing is None else OperationMode.HOMING

    def _rest(self) -> int:
        """Return a target that does not move the drive: its position, or zero velocity or torque."""
        return (self._counts or 0) if self.command_quantity == "position" else 0

    def _send(self, word: int, target: int, mode: OperationMode) -> None:
        """Send the command, if the drive has reported its state and position since it was commissioned."""
        has_reported = self._statusword >= 0 and (self._counts is not None or self.command_quantity != "position")
        if self.is_commissioned and has_reported:
            self._frames.send(self._bus, word, mode, target)
