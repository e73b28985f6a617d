"""Measurement of one device with the motors off, at positions or loads that the operator knows."""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np

from hal import registry
from hal.calibration import store
from hal.calibration.line import CalibrationLine, CalibrationRefused
from hal.calibration.store import Point, Record
from hal.clock import SystemClock
from hal.config import LimitConfig, RobotConfig
from hal.device import DeviceState
from hal.errors import ConfigError, DeviceSilent
from hal.fleet import build
from hal.wire.pulse import pulse

TRIES = 3
SETTLE = 10
"""Values of this number of first cycles are not used."""
MIN_CYCLES = 400
"""A measurement ends without success after this number of cycles, or four times the required number if that is more."""


@dataclass(frozen=True, slots=True)
class Subject:
    """Element that is calibrated.

    Attributes:
        config: The robot file.
        device: Name of the device.
        element: `signal.element` that it measures.
        place: Index of the channel of the device, from 0, and number of channels.
        factor: Name of the setting beside `zero`: `direction` or `gain`.
    """

    config: RobotConfig
    device: str
    element: str
    place: tuple[int, int]
    factor: str

    @property
    def unit(self) -> str:
        """Unit of the element."""
        return self.config.signals[self.element.partition(".")[0]].unit

    def in_force(self, identity: str) -> CalibrationLine:
        """Return the present zero and factor, from an earlier calibration of this very device or the robot file."""
        return self._line(self._measured(identity))

    def _line(self, measured: Mapping[str, Any]) -> CalibrationLine:
        _, settings = registry.equipment(self.config, self.device, measured)
        return CalibrationLine(self._at(settings.zero, 0.0), self._at(getattr(settings, self.factor), 1.0), 0.0)

    def settings(self, line: CalibrationLine, identity: str) -> dict[str, Any]:
        """Return the settings that replace those of the robot file, so that the element follows a line.

        Raises:
            ConfigError: The driver does not accept them.
        """
        _, now = registry.equipment(self.config, self.device, self._measured(identity))
        factor = round(line.factor) if self.factor == "direction" else line.factor
        measured = {
            "zero": self._with(now.zero, line.zero, 0.0),
            self.factor: factor if self.factor == "direction" else self._with(getattr(now, self.factor), factor, 1.0),
        }
        registry.equipment(self.config, self.device, measured)
        return measured

    def limits(self) -> dict[str, LimitConfig]:
        """Return the limits of the robot file, those of the element in its readings without zero and factor."""
        signal, _, element = self.element.partition(".")
        limit = self.config.limits.get(signal)
        if limit is None:
            return dict(self.config.limits)
        line, place = self._line({}), self.config.signals[signal].elements.index(element)
        low, high = self.config.bounds(signal)
        low[place], high[place] = sorted((bound[place] - line.zero) / line.factor for bound in (low, high))
        converted = limit.model_copy(update={"low": tuple(low.tolist()), "high": tuple(high.tolist())})
        return {**self.config.limits, signal: converted}

    def wrap(self, line: CalibrationLine) -> str:
        """Return a warning that an encoder of one turn would jump within the joint's limits; empty if it does not."""
        _, settings = registry.equipment(self.config, self.device)
        signal, _, element = self.element.partition(".")
        if getattr(settings, "around", 0.0) is not None:
            return ""
        low, high = (bound[self.config.signals[signal].elements.index(element)] for bound in self.config.bounds(signal))
        first, last = sorted((line.zero, line.zero + line.factor * 2.0 * math.pi))
        if not (math.isfinite(low) and math.isfinite(high)) or first <= low <= high <= last:
            return ""
        return (
            f"If this encoder measures only one turn, its counts begin again at {line.zero:.4g} rad, within the limits "
            f"{low:.4g} to {high:.4g} rad: give it `around: {(low + high) / 2:.3g}` in the robot file."
        )

    def _measured(self, identity: str) -> Mapping[str, Any]:
        """Return the settings of a valid earlier calibration of this very device; empty without one."""
        for record in store.records(self.config):
            if record.device == self.device and record.identity == identity:
                with contextlib.suppress(ConfigError):  # a refused calibration is not used
                    return store.checked(self.config, record).settings
        return {}

    def _at(self, given: Any, default: float) -> float:
        chosen = given[self.place[0]] if isinstance(given, list | tuple) else given
        return float(default if chosen is None else chosen)

    def _with(self, given: Any, value: float, default: float) -> Any:
        """Return the value, or for several channels a list with the given values of the others."""
        position, count = self.place
        if count == 1:
            return [value] if isinstance(given, list | tuple) else value
        values = list(given) if isinstance(given, list | tuple) else [given] * count
        values[position] = value
        return [default if one is None else one for one in values]


def subject(config: RobotConfig, what: str, factor: str) -> Subject:
    """Find the element that the operator wants to calibrate.

    Args:
        config: The robot file.
        what: A device, or an element that it measures.
        factor: `direction` or `gain`.

    Raises:
        ConfigError: The device or element does not exist, or its driver does not have the setting.
    """
    serving = [name for name, entry in config.devices.items() if what == name or what in entry.served]
    if not serving:
        raise ConfigError(f"'{what}' is neither a device nor an element of one. Devices: {', '.join(config.devices)}.")
    device = serving[0]
    driver, settings = registry.equipment(config, device)
    missing = [name for name in ("zero", factor) if name not in driver.Settings.model_fields]
    if missing:
        other = "joint" if factor == "gain" else "cell"
        raise ConfigError(
            f"Device '{device}' has no setting '{missing[0]}' that could be measured. Is it `gemuco calibrate {other}`?"
        )
    entry, known = config.devices[device], driver.quantities(settings)
    elements = dict(entry.elements) if entry.element is None else {known[0]: entry.element}
    matches = [quantity for quantity, element in elements.items() if element == what]
    quantity = (matches or [quantity for quantity in known if quantity in elements])[0]
    if factor == "direction" and "position" in known and quantity != "position":
        if what != device or "position" not in elements:
            raise ConfigError(f"'{what}' is the {quantity} of '{device}'; zero and direction are of its position.")
        quantity = "position"
    channels = len(getattr(settings, "channels", (1,)))
    return Subject(config, device, elements[quantity], (known.index(quantity) if channels > 1 else 0, channels), factor)


class Measurement:
    """The device of a subject, open while the context lasts; it is never enabled.

    It is read with a zero of 0 and a direction or gain of 1, so that earlier calibrations have no effect.

    Args:
        what: Element that is calibrated.

    Attributes:
        identity: Identity of the device that answered.
    """

    identity: str

    def __init__(self, what: Subject) -> None:
        self._what = what
        config = what.config
        entry = config.devices[what.device]
        plain = {**entry.settings, "zero": 0.0, what.factor: 1 if what.factor == "direction" else 1.0}
        if config.settings_of(what.device).get("around") is not None:  # `around` is a calibrated angle
            plain["around"] = None
        self._clock = SystemClock()
        self._period = 1.0 / config.rates.hal
        device = {what.device: entry.model_copy(update={"settings": plain})}
        alone = config.model_copy(update={"devices": device, "limits": what.limits()})
        buses, built = build(alone, self._clock, calibrations={})
        self._bus = next(bus for bus in buses if bus.name == entry.bus)
        self._device = next(device for device in built if device.name == what.device)
        self._slot = self._device.measures.index(what.element)
        self._newest = -math.inf

    def __enter__(self) -> Self:
        self._bus.open()
        self._open = contextlib.ExitStack()
        self._open.callback(self._bus.close)
        self._open.callback(self._device.close)
        try:
            self._turn = self._open.enter_context(pulse([self._bus]))
            self._revive()
            self.identity = self._device.identity
        except BaseException:
            self._open.close()
            raise
        return self

    def _revive(self) -> None:
        """Open the device, also after it was lost, for example by a loose cable."""
        for left in reversed(range(TRIES)):
            if self._device.health().state is DeviceState.READY:
                return
            try:
                self._device.open()
            except DeviceSilent:
                if not left:
                    raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def measure(self, known: float, duration: float, noise: float) -> Point:
        """Average the readings of the device.

        Args:
            known: True value [the signal's unit].
            duration: Duration [s].
            noise: Largest standard deviation and largest drift allowed [the signal's unit].

        Raises:
            CalibrationRefused: There are too few readings, or they are not constant.
        """
        cycles = max(20, round(duration / self._period))
        for left in reversed(range(TRIES)):
            self._revive()
            fresh, turns = self._gather(cycles)
            if len(fresh) == cycles:
                break
            health = self._device.health()
            if health.state is DeviceState.READY or not left:
                why = health.text or "Is the rate of the robot file too high for it?"
                raise CalibrationRefused(f"'{self._device.name}' sent {len(fresh)} values in {turns} cycles. {why}")
        std, half = float(fresh.std()), len(fresh) // 2
        drift = abs(float(fresh[half:].mean() - fresh[:half].mean()))
        if max(std, drift) > noise:
            unit = self._what.unit
            raise CalibrationRefused(
                f"'{self._device.name}' does not stand still: standard deviation {std:.3g} {unit}, drift {drift:.3g} "
                f"{unit}, and at most {noise:g} {unit} is allowed. Wait until it is still, or allow more with --noise."
            )
        return Point(known=known, read=float(fresh.mean()), std=std, samples=len(fresh))

    def _gather(self, count: int) -> tuple[np.ndarray, int]:
        """Return up to `count` new values [the signal's unit], shape (n,), and the number of cycles."""
        fresh: list[float] = []
        turns = 0
        with self._turn:
            for _ in range(SETTLE):
                self._cycle()
            while len(fresh) < count and turns < max(4 * count, MIN_CYCLES):
                value, turns = self._cycle(), turns + 1
                fresh += [value] if math.isfinite(value) else []
        return np.array(fresh), turns

    def _cycle(self) -> float:
        """Run one cycle and return a new value [the signal's unit]; NaN without one."""
        start = self._clock.monotonic()
        self._bus.begin()
        self._device.idle()
        self._bus.sync(start)
        self._bus.wait(start + 0.8 * self._period)
        reading, slot = self._device.read(), self._slot
        value = float(reading.values[slot]) if reading.received[slot] > self._newest else math.nan
        self._newest = reading.received[slot]
        self._clock.sleep_until(start + self._period)
        return value

    @property
    def now(self) -> CalibrationLine:
        """Present zero and factor of the device that answered."""
        return self._what.in_force(self.identity)

    def record(self, line: CalibrationLine, points: tuple[Point, ...]) -> Record:
        """Return the sealed record to store.

        Raises:
            ConfigError: The driver does not accept the settings.
        """
        what = self._what
        settings = what.settings(line, self.identity)
        return store.sealed(
            Record(
                device=what.device,
                identity=self.identity,
                settings=settings,
                measured_with=store.measured_with(what.config, what.device, settings),
                unit=what.unit,
                points=points,
                residual=line.residual,
            )
        )
