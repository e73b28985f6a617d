"""A sensor with a DBC file. The robot file alone maps its signals to quantities."""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

from cantools.database import Message
from typing_extensions import override

from hal.device import Check, DeviceState
from hal.drivers.can_device import CanDevice, Place
from hal.drivers.dbc.sequence import Address, Inbox, InputMessage, Raws, SequenceRun, Step, compile_steps
from hal.drivers.dbc.settings import MOTION, DbcSettings, QuantityConfig, StepConfig
from hal.errors import ConfigError, DeviceRefused, DeviceSilent
from hal.protocols import dbc
from hal.protocols.can_frames import Frames
from hal.wire.bus import Handler

PERIODS_WAITED = 3.0
"""`open` waits for a message for this many of its periods."""
SHORTEST_WAIT = 0.5
"""`open` waits for a message for at least this time [s]."""
ANSWER_TIME = 0.3
"""A request for the identity is repeated after this time [s]."""
TRIES = 2
"""The identity is requested at most this many times."""
LATE = 1.5
"""`inspect` reports a message whose period is longer than this multiple of the stated one."""
PACE = 50
"""The sending rate is checked once in this many messages."""
TOO_FAST = 0.6
"""Messages that take less than this fraction of their periods are too frequent."""
TWICE_FAST = 2
"""The device is in fault after this many checks in a row with messages that are too frequent."""
POLL = 0.002
"""`open` checks for a new message with this period [s]."""


class DbcNode(CanDevice):
    """One node whose frames a DBC file describes. While its error signal is not good its values are NaN."""

    Settings: ClassVar[type[DbcSettings]] = DbcSettings
    COUNTERS: ClassVar[tuple[str, ...]] = ("malformed", "boots", "commissioned", "failed_openings")
    is_masked_by_error: ClassVar[bool] = True
    """Whether values are invalid while the error signal is not good."""

    @classmethod
    @override
    def quantities(cls, settings: DbcSettings) -> tuple[str, ...]:
        return tuple(settings.quantities)

    @classmethod
    @override
    def traffic_of(
        cls, settings: DbcSettings, rate: float, quantities: tuple[str, ...], folder: Path
    ) -> tuple[Frames, ...]:
        file = dbc.load(folder / settings.dbc)
        return tuple(
            frames_of(file.message(name), rate if period == "cycle" else 1.0 / period, settings.extended)
            for name, period in settings.periods.items()
        )

    def __init__(self, place: Place, settings: DbcSettings) -> None:
        super().__init__(place, settings)
        self._settings = settings
        self._rate = place.rate
        self._paced = -math.inf
        self._fast_checks = 0
        self._address = Address(place.node, settings.node_offset, settings.extended)
        try:
            self._inbox = Inbox(dbc.load(place.folder / settings.dbc))
            self._prepare(settings)
            self._inbox.seal()
            for message in self._inbox.messages.values():
                self._check_kind(message.definition.name, dbc.is_fd(message.definition))
            self._subscribe()
        except ConfigError as error:
            raise ConfigError(f"Device {place}: {error}") from None

    def _prepare(self, settings: DbcSettings) -> None:
        """Look up every name in the settings.

        Raises:
            ConfigError: The DBC file does not have a name, or a period or a time does not fit.
        """
        inbox = self._inbox
        for config in settings.quantities.values():
            inbox.dbc.signal(config.signal)
        self._sources = {quantity: inbox.signal(settings.quantities[quantity].signal) for quantity in self._slots}
        self._main = self._sources[self.commanded(settings) or next(iter(self._slots))].message
        self._error, self._good = None, 0.0
        if settings.error:
            self._error = inbox.signal(settings.error.signal)
            self._good = inbox.dbc.raw(self._error.definition, settings.error.good)
        self._beat = inbox.message(settings.heartbeat.message) if settings.heartbeat else None
        self._identity = [inbox.signal(name) for name in settings.identity.signals] if settings.identity else []
        if any(signal.definition.is_float for signal in self._identity):
            raise ConfigError("identity.signals must be whole numbers.")
        request = settings.identity.ask if settings.identity else None
        self._identity_request = self._steps((request,) if request else ())
        self._opening_steps = self._steps(settings.open)
        self._tare_steps = self._steps(settings.tare)
        for name in settings.periods:
            inbox.dbc.message(name)
        messages = [signal.message for signal in (*self._sources.values(), self._error) if signal]
        for message in (*messages, *([self._beat] if self._beat else [])):
            self._period_of(message)
        self._period = self._period_of(self._main)
        self.patience = 1 if self._period == 0.0 else math.ceil(round(self._period * self._rate, 6)) + 1
        if self._silent_cycles <= self.patience:
            raise ConfigError(
                f"silent_after is {settings.silent_after:g} s, but '{self._main.definition.name}' comes every "
                f"{self._period:g} s. Set it to {(self.patience + 1) / self._rate:.3g} s or more."
            )

    def _period_of(self, message: InputMessage) -> float:
        """Return the period [s] of a message; 0 if it answers every cycle.

        Raises:
            ConfigError: `periods` does not have it.
        """
        periods, name = self._settings.periods, message.definition.name
        period = periods.get(name)
        if period is None:
            raise ConfigError(f"`periods` does not have the period of '{name}'. It has: {', '.join(periods)}.")
        return 0.0 if period == "cycle" else period

    def _steps(self, steps: Sequence[StepConfig]) -> tuple[Step, ...]:
        compiled = compile_steps(steps, self._inbox, self._address, self._rate)
        for step in compiled:
            self._check_kind(step.text, step.frame is not None and step.frame.is_fd)
        return compiled

    def _check_kind(self, what: str, is_fd: bool) -> None:
        """Check that the bus carries frames of CAN FD, if a frame is one.

        Raises:
            ConfigError: It does not.
        """
        if is_fd and not self._bus.is_fd:
            raise ConfigError(
                f"{what} is a frame of CAN FD, and bus '{self._bus.name}' carries classic frames only. Set "
                f"buses.{self._bus.name}.data_bitrate to the bit rate of the data, if the adapter is one for CAN FD."
            )

    def _subscribe(self) -> None:
        for message in self._inbox.messages.values():
            definition = message.definition
            identifier, extended = self._address.identifier(
                definition.frame_id, definition.is_extended_frame, f"message '{definition.name}'"
            )
            self._bus.subscribe(identifier, self._handler(message), extended)

    def _handler(self, message: InputMessage) -> Handler:
        """Return the handler of a message: a closure, because it runs for every frame."""
        assert message.reader is not None
        read, size, counters = message.reader.read, message.reader.size, self._counters
        values, times, measures = self._values, self._received, self._measures(message)
        error, good = self._error if self.is_masked_by_error else None, self._good
        observer, is_multiplexed = self._observer(message), message.definition.is_multiplexed()
        is_main, is_awaited = message is self._main, self.patience == 1
        is_error_here = error is not None and error.message is message and not is_multiplexed
        error_index = error.index if error is not None and is_error_here else -1

        def handle(data: bytearray, received: float) -> None:
            raws = read(data) if len(data) == size else None
            if raws is None:
                counters["malformed"] += 1
                return
            message.raws = _merge(message.raws, raws) if is_multiplexed else raws
            message.received = received
            if observer is not None:
                observer(raws)
            if not self.is_commissioned:
                return
            is_good = error is None or (raws[error_index] if error_index >= 0 else error.raw) == good
            for index, slot, scale, offset in measures:
                raw = raws[index]
                if is_multiplexed and math.isnan(raw):
                    continue  # on another page of the message
                values[slot] = offset + scale * raw if is_good else math.nan
                times[slot] = received
            if is_main:
                self.missed = 0
                if is_awaited:
                    self._bus.answered(self)
                message.count += 1
                if message.count == PACE:
                    self._check_pace(message)

        return handle

    def _check_pace(self, message: InputMessage) -> None:
        is_fast = message.received - self._paced < TOO_FAST * PACE * self._period
        self._fast_checks = self._fast_checks + 1 if is_fast else 0
        self._paced, message.count = message.received, 0

    def _measures(self, message: InputMessage) -> list[tuple[int, int, float, float]]:
        """Return index in the message, slot, scale and offset [SI] of every quantity that the message carries."""
        measures = []
        for quantity, slot in self._slots.items():
            source = self._sources[quantity]
            if source.message is message:
                scale, offset = self._line(quantity, self._settings.quantities[quantity])
                unit = source.definition
                measures.append((source.index, slot, scale * unit.scale, offset + scale * unit.offset))
        return measures

    def _line(self, quantity: str, config: QuantityConfig) -> tuple[float, float]:
        """Return scale and offset [SI] that convert a quantity from the unit of the DBC file."""
        settings = self._settings
        if quantity in MOTION:
            zero = settings.zero if quantity == "position" else 0.0
            return settings.direction * config.scale, zero + settings.direction * config.offset
        if quantity == next(iter(settings.quantities)):
            return settings.gain * config.scale, settings.zero + settings.gain * config.offset
        return config.scale, config.offset

    def _observer(self, message: InputMessage) -> Callable[[Raws], None] | None:
        """Return a further function to call with each frame of a message, in the receive thread."""
        return None

    @override
    def _identify(self) -> str:
        beat = self._beat or self._main
        if not self._comes(beat):
            raise DeviceSilent(
                f"{self._place} sends no '{beat.definition.name}' within {self._longest_wait(beat):g} s. Is it "
                "powered, is its node id right, is it set to send this message?"
            )
        if not self._identity:
            return ""
        message = self._identity[0].message
        since = message.raws
        for _ in range(TRIES):
            self._run("identity", self._identity_request)
            if self._comes(message, since, ANSWER_TIME):
                numbers = "-".join(f"{int(signal.raw):X}" for signal in self._identity)
                return f"dbc:{self._settings.dbc.stem}-{numbers}"
        return ""

    @override
    def _commission(self) -> None:
        self._run("opening", self._opening_steps)
        if self._period and not self._comes(self._main):
            raise DeviceRefused(
                f"{self._place} sends no '{self._main.definition.name}', which must come every {self._period:g} s. "
                "Is it set to send this message?"
            )

    def _longest_wait(self, message: InputMessage) -> float:
        period = self._settings.periods.get(message.definition.name, 0.0)
        return max(SHORTEST_WAIT, PERIODS_WAITED * (0.0 if period == "cycle" else period))

    def _comes(self, message: InputMessage, since: Raws | None = None, timeout: float | None = None) -> bool:
        """Wait for a frame that is newer than `since` (default: than now); return False after the timeout."""
        since = message.raws if since is None else since
        deadline = time.monotonic() + (self._longest_wait(message) if timeout is None else timeout)
        while message.raws is since:
            if time.monotonic() > deadline:
                return False
            time.sleep(POLL)
        return True

    def _run(self, name: str, steps: Sequence[Step], goes_on: bool = False) -> None:
        """Run steps to their end; block until then.

        Raises:
            DeviceRefused: A step was not confirmed, unless the run `goes_on`.
        """
        run = SequenceRun(name, steps, self._rate, goes_on)
        while not run.is_over:
            run.advance(self._bus.send)
            time.sleep(1.0 / self._rate)
        if run.failure:
            raise DeviceRefused(f"{self._place}, {name}: {run.failure}.")

    @override
    def _fault(self) -> str:
        if self._fast_checks < TWICE_FAST:
            return ""
        return (
            f"{self._place} sends '{self._main.definition.name}' more often than every {self._period:g} s. Do two "
            "devices have this node id, or is it set to another period?"
        )

    def _error_text(self) -> str:
        """Return the error that the device reports; empty if none."""
        error, config = self._error, self._settings.error
        if error is None or config is None or not error.message.raws or error.raw == self._good:
            return ""
        return f"{self._place} reports {error.describe(config.bits)} ({config.signal})."

    @override
    def _running(self) -> tuple[DeviceState, str]:
        beat, config = self._beat, self._settings.heartbeat
        if beat and config and self._main.received - beat.received > config.timeout:
            text = f"{self._place} has sent no '{config.message}' for {config.timeout:g} s, but sends other messages."
            return DeviceState.SILENT, text
        return self._state_and_text()

    def _state_and_text(self) -> tuple[DeviceState, str]:
        """Return state and sentence of a device that sends its heartbeat and is not in fault."""
        return DeviceState.READY, self._error_text()

    @override
    def tare(self) -> None:
        if not self._tare_steps:
            super().tare()
        for step in self._tare_steps:
            if step.frame is not None:
                self._bus.send(step.frame)

    @override
    def inspect(self) -> tuple[Check, ...]:
        return tuple(
            self._check_period(message)
            for name, message in self._inbox.messages.items()
            if self._settings.periods.get(name, "cycle") != "cycle"
        )

    def _check_period(self, message: InputMessage) -> Check:
        what, stated = f"message '{message.definition.name}'", self._period_of(message)
        if not self._comes(message):
            return Check(what, False, f"It does not come. Set the device to send it every {stated:g} s.")
        first = message.received
        measured = message.received - first if self._comes(message) else math.inf
        if measured > LATE * stated:
            return Check(
                what, False, f"It comes every {measured:.3g} s, but `periods` has {stated:g} s. Set the device's rate."
            )
        return Check(what, True, f"every {measured:.3g} s")


def frames_of(message: Message, rate: float, extended: bool | None) -> Frames:
    """Return the frames of a DBC message that is sent at a rate [Hz]; `extended` as in `Address`."""
    is_extended = message.is_extended_frame if extended is None else extended
    return Frames(dbc.size_of(message), rate, is_extended, dbc.is_fd(message))


def _merge(before: Raws, now: Raws) -> Raws:
    """Return the values of a multiplexed message; a signal on another page than this one keeps its value."""
    if not before:
        return now
    return tuple([old if math.isnan(new) else new for old, new in zip(before, now, strict=True)])
