"""Whatever measures and has a DBC file: signals become quantities by the robot file alone."""

import math
import time
from collections.abc import Callable, Sequence
from typing import ClassVar

from hal.device import Check, DeviceState
from hal.drivers.can_device import CanDevice, Place
from hal.drivers.dbc.sequence import Address, Inbox, Letter, Raws, Run, Step, compile_steps
from hal.drivers.dbc.settings import MOTION, DbcSettings, QuantityConfig, StepConfig
from hal.errors import ConfigError, DeviceRefused, DeviceSilent
from hal.protocols import dbc
from hal.wire.bus import Handler

PERIODS_WAITED = 3.0
"""A device is there if its message comes within so many of its periods,"""
SHORTEST_WAIT = 0.5
"""and at least so long [s] is waited for it."""
ANSWER_TIME = 0.3
"""How long [s] a device may take to tell who it is,"""
TRIES = 2
"""and how often it is asked."""
FRAME_BYTES = 8
"""What a frame counts in the bus budget, which does not open the DBC file."""
LATE = 1.5
"""A message that comes at more than so many times its stated period is told by `inspect`."""
PACE = 50
"""The pace of what a device sends is looked at once in so many messages;"""
TOO_FAST = 0.6
"""if they took less than this part of their periods,"""
TWICE_FAST = 2
"""so many times in a row, the node id is that of two devices, or the device is set otherwise."""
POLL = 0.002
"""How often [s] `open` looks whether something has come."""


class DbcNode(CanDevice):
    """One node whose frames a DBC file describes. While its error signal is not good its values are NaN."""

    Settings: ClassVar[type[DbcSettings]] = DbcSettings
    COUNTERS: ClassVar[tuple[str, ...]] = ("malformed", "boots", "commissioned", "failed_openings")
    doubts_in_error: ClassVar[bool] = True
    """Whether values are not valid while the error signal is not good."""

    @classmethod
    def quantities(cls, settings: DbcSettings) -> tuple[str, ...]:
        """See `CanDevice.quantities`."""
        return tuple(settings.quantities)

    @classmethod
    def traffic(cls, settings: DbcSettings, rate: float) -> tuple[tuple[int, float, bool], ...]:
        """See `CanDevice.traffic`."""
        rates = [rate if period == "cycle" else 1.0 / period for period in settings.periods.values()]
        return tuple((FRAME_BYTES, one, bool(settings.extended)) for one in rates)

    def __init__(self, place: Place, settings: DbcSettings) -> None:
        super().__init__(place, settings)
        self._settings = settings
        self._rate = place.rate
        self._paced = -math.inf
        self._fast = 0
        self._address = Address(place.node, settings.node_offset, settings.extended)
        try:
            self._inbox = Inbox(dbc.load(place.folder / settings.dbc))
            self._prepare(settings)
            self._inbox.seal()
            self._subscribe()
        except ConfigError as error:
            raise ConfigError(f"Device {place}: {error}") from None

    def _prepare(self, settings: DbcSettings) -> None:
        """Look every name up that the settings use.

        Raises:
            ConfigError: The DBC file does not have it, or a period or a time does not fit.
        """
        inbox = self._inbox
        for config in settings.quantities.values():
            inbox.dbc.signal(config.signal)
        self._sources = {quantity: inbox.signal(settings.quantities[quantity].signal) for quantity in self._slots}
        self._main = self._sources[self.commanded(settings) or next(iter(self._slots))].letter
        self._error = inbox.signal(settings.error.signal) if settings.error else None
        self._good = inbox.dbc.raw(self._error.signal, settings.error.good) if self._error and settings.error else 0.0
        self._beat = inbox.letter(settings.heartbeat.message) if settings.heartbeat else None
        self._who = [inbox.signal(name) for name in settings.identity.signals] if settings.identity else []
        if any(seen.signal.is_float for seen in self._who):
            raise ConfigError("identity.signals must be whole numbers.")
        self._asking = self._steps((settings.identity.ask,) if settings.identity and settings.identity.ask else ())
        self._opening_steps = self._steps(settings.open)
        self._taring = self._steps(settings.tare)
        for name in settings.periods:
            inbox.dbc.message(name)
        relied = [source.letter for source in (*self._sources.values(), self._error) if source]
        for letter in (*relied, *([self._beat] if self._beat else [])):
            self._period_of(letter)
        self._period = self._period_of(self._main)
        self.patience = 1 if self._period == 0.0 else math.ceil(round(self._period * self._rate, 6)) + 1
        if self._silent_cycles <= self.patience:
            raise ConfigError(
                f"silent_after is {settings.silent_after:g} s, and '{self._main.message.name}' comes every "
                f"{self._period:g} s. Make it {(self.patience + 1) / self._rate:.3g} s or more."
            )

    def _period_of(self, letter: Letter) -> float:
        """Period [s] of a message; 0 if it answers every cycle.

        Raises:
            ConfigError: The settings do not say.
        """
        stated = self._settings.periods
        period = stated.get(letter.message.name)
        if period is None:
            raise ConfigError(
                f"`periods` does not say how often '{letter.message.name}' is sent. It has: {', '.join(stated)}."
            )
        return 0.0 if period == "cycle" else period

    def _steps(self, steps: Sequence[StepConfig]) -> tuple[Step, ...]:
        return compile_steps(steps, self._inbox, self._address, self._rate)

    def _subscribe(self) -> None:
        for letter in self._inbox.letters.values():
            message = letter.message
            identifier, extended = self._address.identifier(
                message.frame_id, message.is_extended_frame, f"message '{message.name}'"
            )
            self._bus.subscribe(identifier, self._handler(letter), extended)

    def _handler(self, letter: Letter) -> Handler:
        """What takes a message: a closure over what it needs, since it runs for every frame."""
        assert letter.reader is not None
        read, size, counters = letter.reader.read, letter.reader.size, self._counters
        values, times, measures = self._values, self._received, self._measures(letter)
        error, good = self._error if self.doubts_in_error else None, self._good
        note, has_pages = self._note(letter), letter.message.is_multiplexed()
        is_main, is_awaited = letter is self._main, self.patience == 1
        beside = error.place if error is not None and error.letter is letter and not has_pages else -1

        def handle(data: bytearray, received: float) -> None:
            raws = read(data) if len(data) == size else None
            if raws is None:
                counters["malformed"] += 1
                return
            letter.raws = _merged(letter.raws, raws) if has_pages else raws
            letter.received = received
            if note is not None:
                note(raws)
            if not self.is_commissioned:
                return
            is_good = error is None or (raws[beside] if beside >= 0 else error.raw) == good
            for place, slot, scale, offset in measures:
                raw = raws[place]
                if has_pages and math.isnan(raw):
                    continue  # on another page of the message
                values[slot] = offset + scale * raw if is_good else math.nan
                times[slot] = received
            if is_main:
                self.missed = 0
                if is_awaited:
                    self._bus.answered(self)
                letter.count += 1
                if letter.count == PACE:
                    self._look_at_pace(letter)

        return handle

    def _look_at_pace(self, letter: Letter) -> None:
        is_fast = letter.received - self._paced < TOO_FAST * PACE * self._period
        self._fast = self._fast + 1 if is_fast else 0
        self._paced, letter.count = letter.received, 0

    def _measures(self, letter: Letter) -> list[tuple[int, int, float, float]]:
        """Place in the message, slot, scale and offset [SI] of every quantity that the robot takes from it."""
        found = []
        for quantity, slot in self._slots.items():
            source = self._sources[quantity]
            if source.letter is letter:
                scale, offset = self._line(quantity, self._settings.quantities[quantity])
                found.append((source.place, slot, scale * source.signal.scale, offset + scale * source.signal.offset))
        return found

    def _line(self, quantity: str, config: QuantityConfig) -> tuple[float, float]:
        """Scale and offset [SI] of a quantity, from the unit of the DBC file."""
        settings = self._settings
        if quantity in MOTION:
            zero = settings.zero if quantity == "position" else 0.0
            return settings.direction * config.scale, zero + settings.direction * config.offset
        if quantity == next(iter(settings.quantities)):
            return settings.gain * config.scale, settings.zero + settings.gain * config.offset
        return config.scale, config.offset

    def _note(self, letter: Letter) -> Callable[[Raws], None] | None:
        """What else is done with a message, in the receive thread."""
        return None

    def _identify(self) -> str:
        beat = self._beat or self._main
        if not self._comes(beat):
            raise DeviceSilent(
                f"{self._place} sends no '{beat.message.name}' within {self._waited(beat):g} s. Is it powered, is its "
                "node id right, is it told to send it?"
            )
        if not self._who:
            return ""
        letter = self._who[0].letter
        since = letter.raws
        for _ in range(TRIES):
            self._run("identity", self._asking)
            if self._comes(letter, since, ANSWER_TIME):
                numbers = "-".join(f"{int(seen.raw):X}" for seen in self._who)
                return f"dbc:{self._settings.dbc.stem}-{numbers}"
        return ""

    def _commission(self) -> None:
        self._run("opening", self._opening_steps)
        if self._period and not self._comes(self._main):
            raise DeviceRefused(
                f"{self._place} sends no '{self._main.message.name}', which shall come every {self._period:g} s. Is it "
                "told to send it?"
            )

    def _waited(self, letter: Letter) -> float:
        period = self._settings.periods.get(letter.message.name, 0.0)
        return max(SHORTEST_WAIT, PERIODS_WAITED * (0.0 if period == "cycle" else period))

    def _comes(self, letter: Letter, since: Raws | None = None, timeout: float | None = None) -> bool:
        """Whether a message comes that is newer than `since`, or than now; blocks until then."""
        since = letter.raws if since is None else since
        deadline = time.monotonic() + (self._waited(letter) if timeout is None else timeout)
        while letter.raws is since:
            if time.monotonic() > deadline:
                return False
            time.sleep(POLL)
        return True

    def _run(self, name: str, steps: Sequence[Step], goes_on: bool = False) -> None:
        """Run steps to their end; blocks.

        Raises:
            DeviceRefused: One was not confirmed, unless it `goes_on`.
        """
        run = Run(name, steps, self._rate, goes_on)
        while not run.is_over:
            run.advance(self._bus.send)
            time.sleep(1.0 / self._rate)
        if run.failure:
            raise DeviceRefused(f"{self._place}, {name}: {run.failure}.")

    def _fault(self) -> str:
        if self._fast < TWICE_FAST:
            return ""
        return (
            f"{self._place} sends '{self._main.message.name}' more often than every {self._period:g} s. Do two devices "
            "have this node id, or is it told to?"
        )

    def _error_text(self) -> str:
        """What the device says is wrong; empty if nothing is."""
        error, config = self._error, self._settings.error
        if error is None or config is None or not error.letter.raws or error.raw == self._good:
            return ""
        return f"{self._place} reports {error.words(config.bits)} ({config.signal})."

    def _running(self) -> tuple[DeviceState, str]:
        beat, config = self._beat, self._settings.heartbeat
        if beat and config and self._main.received - beat.received > config.timeout:
            text = f"{self._place} has sent no '{config.message}' for {config.timeout:g} s, though it sends the rest."
            return DeviceState.SILENT, text
        return self._standing()

    def _standing(self) -> tuple[DeviceState, str]:
        """State and sentence of a device that is alive and in no fault."""
        return DeviceState.READY, self._error_text()

    def tare(self) -> None:
        """See `Device.tare`."""
        if not self._taring:
            super().tare()
        for step in self._taring:
            if step.frame is not None:
                self._bus.send(step.frame)

    def inspect(self) -> tuple[Check, ...]:
        """See `Device.inspect`: whether every message comes as often as it shall."""
        return tuple(
            self._check_period(letter)
            for name, letter in self._inbox.letters.items()
            if self._settings.periods.get(name, "cycle") != "cycle"
        )

    def _check_period(self, letter: Letter) -> Check:
        what, stated = f"message '{letter.message.name}'", self._period_of(letter)
        if not self._comes(letter):
            return Check(what, False, f"It does not come. Set the device to send it every {stated:g} s.")
        first = letter.received
        found = letter.received - first if self._comes(letter) else math.inf
        if found > LATE * stated:
            return Check(
                what, False, f"It comes every {found:.3g} s, and `periods` says {stated:g} s. Set the device's rate."
            )
        return Check(what, True, f"every {found:.3g} s")


def _merged(before: Raws, now: Raws) -> Raws:
    """What a multiplexed message says: signals on other pages than this one are as they were."""
    if not before:
        return now
    return tuple([old if math.isnan(new) else new for old, new in zip(before, now, strict=True)])
