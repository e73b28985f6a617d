"""A servo with a DBC file. The robot file adds what a DBC file cannot contain: states, sequences and the watchdog."""

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np
from typing_extensions import override

from hal.device import UNDER_POWER, Check, DeviceState
from hal.drivers.can_device import Place
from hal.drivers.dbc.sensor import POLL, DbcNode, frames_of
from hal.drivers.dbc.sequence import InputMessage, Raws, SequenceRun, Step, is_extended, message_of
from hal.drivers.dbc.settings import DbcSettings, QuantityConfig, ServoSettings, Value
from hal.errors import ConfigError, DeviceSilent
from hal.protocols import dbc
from hal.protocols.can_frames import Frames
from hal.protocols.dbc import Writer

log = logging.getLogger(__name__)

FED_CYCLES = 3
"""A watchdog with a timeout of fewer cycles would stop the servo at the first late cycle."""
ENABLE, DISABLE, QUICK_STOP, RESET = "enabling", "disabling", "quick stop", "reset"
"""Names of the sequences in messages."""
BOOTING = "booting"
BOOT_TIME = 2.0
"""`open` waits at most this time [s] for a servo that starts up."""


class DbcServo(DbcNode):
    """One servo. Only `enable` enables it; a servo that leaves its enabled state by itself stays disabled."""

    Settings: ClassVar[type[ServoSettings]] = ServoSettings
    COUNTERS: ClassVar[tuple[str, ...]] = (*DbcNode.COUNTERS, "watchdog_expired")
    is_masked_by_error = False
    _settings: ServoSettings

    @classmethod
    @override
    def commanded(cls, settings: ServoSettings) -> str:
        return settings.command.quantity

    @classmethod
    @override
    def traffic_of(
        cls, settings: DbcSettings, rate: float, quantities: tuple[str, ...], folder: Path
    ) -> tuple[Frames, ...]:
        assert isinstance(settings, ServoSettings)
        file, received = dbc.load(folder / settings.dbc), super().traffic_of(settings, rate, quantities, folder)
        names = [settings.command.send, *(step.send for step in settings.cyclic if step.send is not None)]
        sent = [frames_of(file.message(name), rate, settings.extended) for name in names]
        raw = [
            Frames(len(frame.data), rate, is_extended(frame, settings.extended))
            for step in settings.cyclic
            if (frame := step.frame) is not None
        ]
        return (*received, *sent, *raw)

    def __init__(self, place: Place, settings: ServoSettings) -> None:
        self._enable_requested = False
        self._enable_succeeded = False
        self._stopped_by_watchdog = False
        self._is_booting = False
        self._has_expired = False
        self._was_enabled = False
        self._drop_text = ""
        self._hold = 0.0
        super().__init__(place, settings)
        self._activity = SequenceRun("nothing", (), place.rate)
        self._slot = self._slots[settings.command.quantity]

    @override
    def _prepare(self, settings: DbcSettings) -> None:
        super()._prepare(settings)
        assert isinstance(settings, ServoSettings)
        state = settings.state
        self._state = self._inbox.signal(state.signal)
        self._period_of(self._state.message)
        self._reason = self._inbox.signal(state.reason) if state.reason else None
        self._meaning: dict[float, DeviceState | str] = {}
        meanings: tuple[tuple[DeviceState | str, tuple[Value, ...]], ...] = (
            (DeviceState.READY, state.ready),
            (DeviceState.ENABLED, state.enabled),
            (DeviceState.HOMING, state.busy),
            (DeviceState.FAULT, state.fault),
            (BOOTING, state.booting),
        )
        for meaning, values in meanings:
            for value in values:
                raw = self._inbox.dbc.raw(self._state.definition, value)
                if self._meaning.setdefault(raw, meaning) != meaning:
                    raise ConfigError(f"the value {value} of {state.signal} has two meanings in `state`.")
        self._sequences = {
            ENABLE: self._steps(settings.enable),
            DISABLE: self._steps(settings.disable),
            QUICK_STOP: self._steps(settings.quick_stop or settings.disable),
            RESET: self._steps(settings.reset),
        }
        self._cyclic = self._steps(settings.cyclic)
        self._prepare_command(settings)
        self._prepare_watchdog(settings)

    def _prepare_command(self, settings: ServoSettings) -> None:
        command, dbc = settings.command, self._inbox.dbc
        message = dbc.message(command.send)
        self._writer = Writer(dbc, message, command.values, command.signal)
        self._frame = message_of(dbc, self._address, command.send, self._writer.data)
        self._check_kind(command.send, self._frame.is_fd)
        measured = settings.quantities[command.quantity]
        config = QuantityConfig(
            signal=f"{command.send}.{command.signal}",
            scale=measured.scale if command.scale is None else command.scale,
            offset=measured.offset if command.offset is None else command.offset,
        )
        signal = dbc.signal_of(message, command.signal)
        scale, offset = self._line(command.quantity, config)
        self._scale, self._offset = scale * signal.scale, offset + scale * signal.offset
        self._is_position = command.quantity == "position"
        self.can_damp = settings.damping is not None
        if self.can_damp and "velocity" not in self._slots:
            raise ConfigError("damping needs the velocity, which is not in `elements`.")

    def _prepare_watchdog(self, settings: ServoSettings) -> None:
        watchdog = settings.watchdog
        self._no_watchdog = "" if watchdog else f"{self._place} goes on with its last set-point when the host dies."
        self._watchdog_steps: tuple[Step, ...] = self._steps(watchdog.configure) if watchdog else ()
        self._expired = self._inbox.condition(watchdog.expired) if watchdog and watchdog.expired else None
        if watchdog is None:
            return
        for name in watchdog.fed_by:
            self._inbox.dbc.message(name)
        if watchdog.timeout < FED_CYCLES / self._rate:
            raise ConfigError(
                f"watchdog.timeout is {watchdog.timeout:g} s, which is less than {FED_CYCLES} cycles at "
                f"{self._rate:g} Hz: the servo would stop at the first late cycle."
            )

    @override
    def _observer(self, message: InputMessage) -> Callable[[Raws], None] | None:
        if message is self._state.message:
            return self._on_state
        return self._on_watchdog if self._expired and message is self._expired.signal.message else None

    def _on_state(self, raws: Raws) -> None:
        if self._expired and self._expired.signal.message is self._state.message:
            self._on_watchdog(raws)
        is_booting = self._meaning.get(self._state.raw) == BOOTING
        if is_booting and not self._is_booting:
            self._counters["boots"] += 1
            self._lose(f"{self._place} rebooted.")
        self._is_booting = is_booting
        self._was_enabled = self._is_enabled

    def _on_watchdog(self, raws: Raws) -> None:
        has_expired = self._expired is not None and self._expired.is_met()
        if has_expired and not self._has_expired:
            self._counters["watchdog_expired"] += 1
            self._stopped_by_watchdog = self._enable_requested or self._was_enabled
        self._has_expired = has_expired

    @override
    def _lose(self, text: str) -> None:
        super()._lose(text)
        self._enable_requested = False

    @property
    def _is_enabled(self) -> bool:
        return self._meaning.get(self._state.raw) is DeviceState.ENABLED

    @override
    def _identify(self) -> str:
        identity = super()._identify()
        deadline = time.monotonic() + BOOT_TIME
        while self._is_booting:
            if time.monotonic() > deadline:
                raise DeviceSilent(f"{self._place} has been starting up for {BOOT_TIME:g} s.")
            time.sleep(POLL)
        return identity

    @override
    def _commission(self) -> None:
        self._enable_requested = False
        self._activity = SequenceRun("nothing", (), self._rate)
        if not self._state.message.raws:
            self._comes(self._state.message)
        if self._is_enabled:
            self._run(DISABLE, self._sequences[DISABLE])
        super()._commission()
        self._run("watchdog", self._watchdog_steps)
        if self._expired_disabled:
            log.warning("%s: its watchdog ran out before it was opened; it is reset", self._place)
            self._run(RESET, self._sequences[RESET], goes_on=True)

    @override
    def _release(self) -> None:
        if self.is_heard:
            self._run(DISABLE, self._sequences[DISABLE], goes_on=True)

    @property
    def _expired_disabled(self) -> bool:
        """Whether the watchdog ran out while the servo was disabled, where it was not fed and stopped no motion."""
        return self._has_expired and not self._stopped_by_watchdog

    @override
    def _fault(self) -> str:
        if text := super()._fault():
            return text
        if self._expired_disabled:
            return ""
        if text := self._error_text():
            return text
        if self._meaning.get(self._state.raw, DeviceState.FAULT) is DeviceState.FAULT:
            return f"{self._place} is in its state '{self._state.describe()}' ({self._settings.state.signal})."
        return ""

    @override
    def _drives(self) -> bool:
        return self._meaning.get(self._state.raw) in UNDER_POWER

    @override
    def _state_and_text(self) -> tuple[DeviceState, str]:
        meaning = self._meaning.get(self._state.raw)
        if meaning is DeviceState.ENABLED:
            return DeviceState.ENABLED, ""
        if meaning is DeviceState.HOMING:
            return DeviceState.HOMING, f"{self._place} is in its state '{self._state.describe()}'."
        return DeviceState.READY, self._drop_text or self._no_watchdog

    @override
    def enable(self) -> None:
        self._enable_requested, self._enable_succeeded, self._drop_text = True, False, ""
        first = self._sequences[RESET] if self._has_expired else ()
        self._activity = SequenceRun(ENABLE, (*first, *self._sequences[ENABLE]), self._rate)

    @override
    def disable(self) -> None:
        self._enable_requested = False
        if not self._is_stopping:
            self._begin(DISABLE)

    @override
    def quick_stop(self) -> None:
        self._enable_requested = False
        if not self._is_stopping:
            self._begin(QUICK_STOP)
            self._activity.advance(self._bus.send)  # at once, because the cycle may be stuck

    @property
    def _is_stopping(self) -> bool:
        return self._activity.name == QUICK_STOP and not self._activity.is_over

    @override
    def reset(self) -> None:
        self._stopped_by_watchdog = False
        self._drop_text = ""
        self._begin(RESET)

    def _begin(self, name: str) -> None:
        self._activity = SequenceRun(name, self._sequences[name], self._rate, goes_on=True)

    @override
    def apply(self, values: np.ndarray) -> None:
        self._follow(float(values[0]))

    @override
    def damp(self) -> None:
        velocity = float(self._values[self._slots["velocity"]])
        self._follow(-(self._settings.damping or 0.0) * velocity if np.isfinite(velocity) else 0.0)

    def _follow(self, target: float) -> None:
        """Send the set-point [SI]; until the servo is enabled, send one that does not move it, and enable it."""
        if not self._enable_requested:
            self.idle()
            return
        activity, is_enabled = self._activity, self._is_enabled
        if activity.failure or (self._enable_succeeded and not is_enabled):
            self._drop(activity.failure)
            self.idle()
            return
        if is_enabled and activity.is_over:
            self._enable_succeeded = True
            self._send(target)
            return
        if not activity.has_sent_last:
            self._hold = self._rest
        self._send(self._hold)
        activity.advance(self._bus.send)

    @override
    def idle(self) -> None:
        if not self.is_commissioned:
            return
        activity = self._activity
        if self._is_enabled if activity.is_over else activity.name == ENABLE:
            self._begin(DISABLE)
        elif activity.is_over and self._expired_disabled:
            self._begin(RESET)
        if self._settings.command.while_disabled:
            self._send(self._rest)
        else:
            self._send_cyclic()
        self._activity.advance(self._bus.send)

    def _drop(self, failure: str) -> None:
        """Disable a servo that cannot be enabled, or that left its enabled state by itself."""
        self._enable_requested = False
        reason = f", {self._reason.describe()}" if self._reason else ""
        state = f"'{self._state.describe()}'{reason}"
        if failure:
            self._drop_text = f"{self._place} cannot be enabled: {failure}; its state is {state}."
        else:
            self._drop_text = f"{self._place} left its enabled state by itself and is {state}."
        self._begin(DISABLE)

    @property
    def _rest(self) -> float:
        """Set-point [SI] that does not move the servo: its position, or zero velocity or effort."""
        return float(self._values[self._slot]) if self._is_position else 0.0

    def _send(self, value: float) -> None:
        """Send the set-point [SI], unless the servo is silent: then its own watchdog is allowed to run out."""
        if self.is_commissioned and self.is_heard and np.isfinite(value):
            self._writer.write((value - self._offset) / self._scale)
            self._bus.send(self._frame)
            self._send_cyclic()

    def _send_cyclic(self) -> None:
        for step in self._cyclic:
            if step.frame is not None:
                self._bus.send(step.frame)

    @override
    def inspect(self) -> tuple[Check, ...]:
        return (*super().inspect(), self._check_watchdog())

    def _check_watchdog(self) -> Check:
        """Return whether the watchdog works; its only proof is that it ran out before."""
        watchdog = self._settings.watchdog
        if watchdog is None:
            return Check("watchdog", False, "There is none: it goes on with its last set-point when the host dies.")
        if self._counters["watchdog_expired"]:
            return Check(
                "watchdog", True, f"It has run out before; its timeout in the robot file: {watchdog.timeout:g} s."
            )
        if self._expired is None:
            return Check("watchdog", True, f"{watchdog.timeout:g} s by the robot file; this cannot be checked.")
        text = f"It has not run out yet. Is it switched on in the device, with {watchdog.timeout:g} s?"
        return Check("watchdog", False, text)
