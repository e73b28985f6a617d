"""Analogue channels of CANopen devices: load cells [N], torque [N m] and pressure [Pa] by CiA 401 and CiA 404."""

import logging
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from hal.commissioning.pdo_map import Pdo, PdoMap, lay_out
from hal.config import Finite, Positive
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen.node import HEARTBEAT, CanopenNode, NodeSettings, Taker, data_sheet
from hal.errors import CommandRefused, ConfigError, DeviceRefused, HalError
from hal.protocols import analog, cia301
from hal.protocols.cia301 import Mapped


def _differ(values: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(values)) < len(values):
        raise ValueError(f"{', '.join(map(str, values))} names a channel twice")
    return values


ChannelNumber = Annotated[int, Field(ge=1, le=254)]


class AnalogSettings(NodeSettings):
    """Settings of a device with measuring channels: value = zero + gain * what the device says."""

    measures: Literal["force", "torque", "pressure"] = "force"
    """What the channels measure [N, N m or Pa]; also the name of the quantity."""
    channels: Annotated[tuple[ChannelNumber, ...], Field(min_length=1), AfterValidator(_differ)] = (1,)
    """Sub-indices that are used. The quantity of one is called `force`, those of several `force_1`, `force_2`..."""
    value: str | None = None
    """Object and type in place of the preset's, as `7130h int16`; the sub-index is the channel unless it is given."""
    status: str | None = None
    """Object and type that tells whether the value is good, in place of the preset's, as `2120h:0 uint16`; the
    sub-index is the channel unless it is given."""
    bad_status: Annotated[int, Field(ge=1)] = 0xFFFF_FFFF
    """Bits of the status that make a value bad."""
    gain: Finite | tuple[Finite, ...] | None = None
    """SI units per unit of the device, one number or one per channel; negative if pulling reads negative. It must be
    given where the device tells raw counts; else 1."""
    zero: Finite | tuple[Finite, ...] = 0.0
    """Added [SI unit], one number or one per channel."""
    frozen_after: Positive | None = None
    """A value that stays the same to the last bit for so long [s] is not believed; only for a cell whose last bit is
    noise."""


@dataclass(slots=True)
class Channel:
    """One measuring channel.

    Attributes:
        number: Its sub-index.
        quantity: As the robot file names it.
        value: What is mapped.
        status: What tells whether the value is good; None if nothing does.
        slot: Where in `read` its value goes.
        zero: Added [SI unit].
        gain: As set.
        scale: SI units per number of the device; not known before it was read from there.
        bounds: Numbers at or beyond which the value is an overload.
        bad: Status bits now that make the value bad.
        number_now: What the device said last.
        changed: When that was another number [monotonic s].
        trouble: Why the value now is not to be used; empty if it is.
    """

    number: int
    quantity: str
    value: Mapped
    status: Mapped | None
    slot: int
    zero: float
    gain: float
    bounds: tuple[float, float]
    scale: float = math.nan
    bad: int = 0
    number_now: float = math.nan
    changed: float = -math.inf
    trouble: str = ""


class AnalogNode(CanopenNode):
    """Channels whose values answer every SYNC. A value that the device does not vouch for is NaN."""

    Settings = AnalogSettings

    @classmethod
    def quantities(cls, settings: Any) -> tuple[str, ...]:
        """See `CanDevice.quantities`."""
        if len(settings.channels) == 1:
            return (settings.measures,)
        return tuple(f"{settings.measures}_{number}" for number in settings.channels)

    @classmethod
    def traffic(cls, settings: Any, rate: float) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic`."""
        return cls.traffic_of(settings, rate, cls.quantities(settings))

    @classmethod
    def traffic_of(cls, settings: Any, rate: float, quantities: tuple[str, ...]) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic_of`."""
        channels = zip(settings.channels, cls.quantities(settings), strict=True)
        objects = [cls._objects(settings, number) for number, quantity in channels if quantity in quantities]
        return (*_map(objects).frames(rate), HEARTBEAT)

    @classmethod
    def _objects(cls, settings: Any, channel: int) -> tuple[Mapped, Mapped | None]:
        """Value and status of a channel."""
        raise NotImplementedError

    def __init__(self, place: Place, settings: AnalogSettings, profile: int) -> None:
        """Prepare; what is not read by the robot file is not mapped.

        Raises:
            ConfigError: An object, a gain or a zero that makes no sense.
        """
        used = [
            (slot, position, number)
            for position, (number, quantity) in enumerate(
                zip(settings.channels, self.quantities(settings), strict=True)
            )
            for slot, name in enumerate(place.elements)
            if name == quantity
        ]
        self._channels = [self._channel(place, settings, *entry) for entry in used]
        self._settings = settings
        super().__init__(place, settings, profile, _map([(c.value, c.status) for c in self._channels]))

    def _channel(self, place: Place, settings: AnalogSettings, slot: int, position: int, number: int) -> Channel:
        value, status = self._objects(settings, number)
        if status is not None and settings.status is None:  # a device may do without one
            entry = data_sheet(place.folder / settings.eds).get_variable(status.index, status.subindex)
            status = status if entry is not None and entry.pdo_mappable else None
        gain = _of(settings.gain, settings, position, f"{place}: gain")
        zero = _of(settings.zero, settings, position, f"{place}: zero")
        if gain == 0.0:
            raise ConfigError(f"{place}: a gain of zero would make every value the same.")
        quantity = self.quantities(settings)[position]
        bounds = self._bounds(settings, value)
        return Channel(number, quantity, value, status, slot, zero or 0.0, gain or 1.0, bounds)

    def _bounds(self, settings: Any, value: Mapped) -> tuple[float, float]:
        """Numbers at or beyond which a value is an overload: the ends of its type."""
        if value.kind == "float":
            return -math.inf, math.inf
        if value.kind == "unsigned":
            return -1, (1 << value.bits) - 1
        half = 1 << value.bits - 1
        return -half, half - 1

    def _taker(self, pdo: Pdo) -> Taker:
        places = {item: place for place, item in enumerate(pdo.objects)}
        statuses = [(places[c.status], c) for c in self._channels if c.status in places]
        values = [(places[c.value], c) for c in self._channels if c.value in places]
        bad = self._settings.bad_status

        def take(objects: tuple[Any, ...], received: float) -> None:
            for place, channel in statuses:
                channel.bad = objects[place] & bad
            for place, channel in values:
                self._measure(channel, objects[place], received)

        return take

    def _measure(self, channel: Channel, number: float, received: float) -> None:
        """Keep a value, or NaN if the device, an emergency, its range or its stillness says that it is none."""
        low, high = channel.bounds
        if number != channel.number_now:
            channel.number_now, channel.changed = number, received
        limit = self._settings.frozen_after
        if channel.bad:
            channel.trouble = self._describe(channel.bad)
        elif not low < number < high:
            channel.trouble = "overload: it reads an end of its range"
        elif limit is not None and received - channel.changed > limit:
            channel.trouble = f"frozen: its value has not changed by a bit for more than {limit:g} s"
        elif self._emergency or self._twin:
            channel.trouble = "the device reports a fault"
        else:
            channel.trouble = ""
            self._keep(channel.slot, channel.zero + channel.gain * channel.scale * number, received)
            return
        self._keep(channel.slot, math.nan, received)

    def _describe(self, bad: int) -> str:
        """Bad status bits in words."""
        return f"status {bad:X}h"

    def _troubles(self) -> list[str]:
        """What is wrong though the device answers and reports no fault."""
        return [f"{channel.quantity}: {channel.trouble}" for channel in self._channels if channel.trouble]

    def _running(self) -> tuple[DeviceState, str]:
        troubles = self._troubles()
        return DeviceState.READY, f"{self._place}: {'; '.join(troubles)}." if troubles else ""


def parse(text: str, channel: int, what: str) -> Mapped:
    """The object of a channel that a person writes as `7130h int16` or, with its sub-index, `2120h:0 uint16`.

    Raises:
        ConfigError: It is none.
    """
    place, _, kind = text.strip().partition(" ")
    try:
        found = cia301.mapped(place, kind.strip())
    except ValueError as error:
        raise ConfigError(f"{what} '{text}': {error} Write an object and its type: 7130h int16.") from None
    return found if ":" in place else Mapped(found.index, channel, found.bits, found.kind)


def _of(given: float | tuple[float, ...] | None, settings: AnalogSettings, position: int, what: str) -> float | None:
    """The number of one channel, where one was given for all or one for each."""
    if not isinstance(given, tuple):
        return given
    if len(given) != len(settings.channels):
        raise ConfigError(f"{what} has {len(given)} numbers for {len(settings.channels)} channels.")
    return given[position]


def _map(channels: Sequence[tuple[Mapped, Mapped | None]]) -> PdoMap:
    """A channel's value and its own status in one PDO; a status that is all channels' in the first."""
    statuses = [status for _, status in channels]
    shared = statuses[0] if statuses and len(channels) > 1 and len(set(statuses)) == 1 else None
    groups = [(value,) if status in (None, shared) else (value, status) for value, status in channels]
    return PdoMap(sends=lay_out([(shared,), *groups] if shared else groups))


INPUT_PRESETS = dict(analog.INPUTS) | {
    # Seneca ZC-SG strain gauge converter, user manual: 6403h:1 is the weight; overload and errors come as EMCY FF10h.
    "zc_sg": analog.INPUTS["float32"],
}


class InputSettings(AnalogSettings):
    """Settings of analogue inputs; `gain` must be given, SI units per count (or per unit of the float object)."""

    preset: Literal["int16", "int32", "float32", "zc_sg"] = "int16"
    """Which object is the value: 6401h as `int16`, 6402h as `int32`, 6403h as `float32`; or a family of converters."""
    resolution: Annotated[int, Field(ge=2, le=32)] | None = None
    """Bits of the converter, whose ends count as overload; absent: as many as the object has."""


class Cia401Input(AnalogNode):
    """Analogue inputs. The device has no unit and no tare: both are the calibration's."""

    Settings = InputSettings

    @classmethod
    def _objects(cls, settings: InputSettings, channel: int) -> tuple[Mapped, Mapped | None]:
        item = INPUT_PRESETS[settings.preset]
        value = Mapped(item.index, channel, item.bits, item.kind)
        if settings.value is not None:
            value = parse(settings.value, channel, "value")
        return value, None if settings.status is None else parse(settings.status, channel, "status")

    def __init__(self, place: Place, settings: InputSettings) -> None:
        if settings.gain is None:
            raise ConfigError(f"{place} tells counts. Give `gain`, the {settings.measures} of one count in SI units.")
        super().__init__(place, settings, analog.INPUT_PROFILE)

    def _bounds(self, settings: Any, value: Mapped) -> tuple[float, float]:
        low, high = super()._bounds(settings, value)
        bits = settings.resolution
        if bits is None or value.kind == "float" or bits >= value.bits:
            return low, high
        return low, high >> value.bits - bits << value.bits - bits

    def _calibrate(self) -> None:
        for channel in self._channels:
            channel.scale = 1.0

    def _writes(self) -> tuple[tuple[Mapped, int], ...]:
        enable = analog.INTERRUPT_ENABLE
        return ((enable, 1),) if self._sdo.has(enable.index) else ()


log = logging.getLogger(__name__)

COUNTS = "counts"
"""In place of a unit: the device tells raw counts, and `gain` says what one of them is."""


@dataclass(frozen=True, slots=True)
class Preset:
    """What is known of an amplifier, under a name for the robot file.

    Attributes:
        form: Which of the objects it offers is the value.
        unit: What its numbers are; None: it says so itself (6131h).
    """

    form: analog.Form
    unit: str | None = None


CELL_PRESETS = {name: Preset(form, None if form.has_unit else COUNTS) for name, form in analog.FORMS.items()} | {
    # Baumer StrainLink DSRT, manual V3.05, 6.3: 7130h, 6132h, 6150h, 6125h; it tells strain, which gain makes a force.
    "strain_link": Preset(analog.FORMS["int16"], COUNTS),
}
PresetName = Literal["float32", "int16", "int32", "counts16", "counts32", "strain_link"]


class CellSettings(AnalogSettings):
    """Settings of a load cell; by default unit and decimal digits are read from the device."""

    preset: PresetName = "int32"
    """Which object is the value: 6130h as `float32`, 7130h as `int16`, 9130h as `int32`, or before any scaling 7100h as
    `counts16`, 9100h as `counts32`; or a family of amplifiers."""
    unit: str | None = None
    """What the device's numbers are, in place of what it says in 6131h: `N`, `kN`, `kg`, `N m`, `bar`, ... `counts`."""
    digits: int | None = None
    """Decimal digits of a whole number, in place of what the device says in 6132h."""


class Cia404Cell(AnalogNode):
    """Channels of a measuring amplifier; a tare that the device forgets when it reboots is given back to it."""

    Settings = CellSettings
    COUNTERS = (*AnalogNode.COUNTERS, "tared")

    @classmethod
    def _objects(cls, settings: CellSettings, channel: int) -> tuple[Mapped, Mapped | None]:
        form = CELL_PRESETS[settings.preset].form
        value, status = (
            Mapped(item.index, channel, item.bits, item.kind) if item else None for item in (form.value, form.status)
        )
        if settings.value is not None:
            value = parse(settings.value, channel, "value")
        if settings.status is not None:
            status = parse(settings.status, channel, "status")
        assert value is not None
        return value, status

    def __init__(self, place: Place, settings: CellSettings) -> None:
        self._unit = settings.unit or CELL_PRESETS[settings.preset].unit
        self._fixed = self._known_unit(place, settings)
        self._cell = settings
        self._offsets: dict[int, int] = {}
        self._tare_text = ""
        super().__init__(place, settings, analog.CELL_PROFILE)

    def _known_unit(self, place: Place, settings: CellSettings) -> float | None:
        """SI units per unit of the device, if the robot file or the preset says so.

        Raises:
            ConfigError: Another quantity's unit, none at all, or counts without a gain.
        """
        if self._unit is None:
            return None
        if self._unit == COUNTS:
            if settings.gain is None:
                raise ConfigError(f"{place} tells counts. Give `gain`, the {settings.measures} of one count, SI units.")
            return 1.0
        known = [name for name, unit in analog.UNITS.items() if unit.quantity == settings.measures]
        if self._unit not in known:
            raise ConfigError(f"{place}: '{self._unit}' is no unit of {settings.measures}. Known: {', '.join(known)}.")
        return analog.UNITS[self._unit].scale

    def _calibrate(self) -> None:
        for channel in self._channels:
            channel.scale = self._unit_scale(channel) * 10.0 ** -self._digits(channel)
        for number, offset in self._offsets.items():
            self._sdo.write_checked(analog.OFFSET, number, offset, 4)

    def _unit_scale(self, channel: Channel) -> float:
        if self._fixed is not None:
            return self._fixed
        code = self._sdo.read(analog.UNIT_CODE, channel.number)
        unit = analog.unit(code)
        if unit is None or unit.quantity != self._settings.measures:
            raise DeviceRefused(
                f"{self._place} measures in unit {code:08X}h (6131h:{channel.number}), which is no "
                f"{self._settings.measures}. Is it the right device? If the unit is wrong, give `unit`."
            )
        return unit.scale

    def _digits(self, channel: Channel) -> int:
        if self._cell.digits is not None:
            return self._cell.digits
        if not CELL_PRESETS[self._cell.preset].form.has_digits or channel.value.kind == "float":
            return 0
        return self._sdo.read(analog.DIGITS, channel.number)

    def tare(self) -> None:
        """See `Device.tare`; `health` tells what came of it, and counts it as `tared`."""
        if not self.is_commissioned:
            raise CommandRefused(f"{self._place} cannot be tared: {self._trouble[1]}")
        self._tare_text = "being tared"
        self.long_request = self._tare

    def _tare(self) -> None:
        """Have every channel take what it measures as zero, and remember what it takes to do so again."""
        try:
            for channel in self._channels:
                self._sdo.write(analog.AUTOZERO, channel.number, analog.ZERO, 4)
                if self._sdo.has(analog.OFFSET, channel.number):
                    self._offsets[channel.number] = self._offset(channel.number)
        except HalError as error:
            self._tare_text = f"not tared: {str(error).rstrip('.')}"
            return
        self._tare_text = ""
        self._counters["tared"] += 1
        log.info("%s is tared", self._place)

    def _offset(self, number: int) -> int:
        """What the tare has set, as the bits of a REAL32."""
        bits = self._sdo.read(analog.OFFSET, number)
        if not math.isfinite(struct.unpack("<f", bits.to_bytes(4, "little"))[0]):
            raise DeviceRefused(f"{self._place} says after the tare that its offset (6124h:{number}) is no number.")
        return bits

    def _describe(self, bad: int) -> str:
        return analog.describe_status(bad) if self._cell.status is None else super()._describe(bad)

    def _troubles(self) -> list[str]:
        return [*super()._troubles(), *([self._tare_text] if self._tare_text else [])]
