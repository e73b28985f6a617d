"""Analogue channels of CANopen devices: load cells [N], torque [N m] and pressure [Pa] by CiA 401 and CiA 404."""

import logging
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field
from typing_extensions import override

from hal.commissioning.pdo_map import Pdo, PdoMap, lay_out
from hal.config import Finite, Positive
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen.node import HEARTBEAT, CanopenNode, NodeSettings, PdoHandler, data_sheet
from hal.errors import CommandRefused, ConfigError, DeviceRefused, HalError
from hal.protocols import analog, cia301
from hal.protocols.cia301 import MappedObject


def _refuse_duplicates(values: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(values)) < len(values):
        raise ValueError(f"{', '.join(map(str, values))} names a channel twice")
    return values


ChannelNumber = Annotated[int, Field(ge=1, le=254)]


class AnalogSettings(NodeSettings):
    """Settings of a device with measuring channels: value = zero + gain * number of the device."""

    measures: Literal["force", "torque", "pressure"] = "force"
    """Measured quantity [N, N m or Pa]."""
    channels: Annotated[tuple[ChannelNumber, ...], Field(min_length=1), AfterValidator(_refuse_duplicates)] = (1,)
    """Sub-indices of the channels in use. A single quantity is named `force`, several are named `force_1`,
    `force_2`..."""
    value: str | None = None
    """Object and type that replace the preset's, as `7130h int16`; default sub-index: the channel."""
    status: str | None = None
    """Object and type of the status of a value that replace the preset's, as `2120h:0 uint16`; default sub-index: the
    channel."""
    bad_status: Annotated[int, Field(ge=1)] = 0xFFFF_FFFF
    """Bits of the status that make a value invalid."""
    gain: Finite | tuple[Finite, ...] | None = None
    """SI units per unit of the device, one number or one per channel; negative if pulling reads negative. Required for
    a device that sends raw counts; else 1."""
    zero: Finite | tuple[Finite, ...] = 0.0
    """Added [SI unit], one number or one per channel."""
    frozen_after: Positive | None = None
    """A value becomes invalid after this time [s] without a change of any bit; only for a cell whose last bit is
    noise."""


@dataclass(slots=True)
class Channel:
    """One measuring channel.

    Attributes:
        number: Its sub-index.
        quantity: Name of its quantity in the robot file.
        value: Object of the value.
        status: Object of the status; None without one.
        slot: Index of its value in `read`.
        zero: Added [SI unit].
        gain: Gain of the settings.
        scale: SI units per number of the device; NaN before it was read from the device.
        bounds: A number at or beyond one of these is an overload.
        bad: Present status bits that make the value invalid.
        number_now: Newest number of the device.
        changed: Time of its last change [monotonic s].
        trouble: Reason why the present value is invalid; empty if it is valid.
    """

    number: int
    quantity: str
    value: MappedObject
    status: MappedObject | None
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
    """Channels whose values answer every SYNC. An invalid value is NaN."""

    Settings = AnalogSettings

    @classmethod
    @override
    def quantities(cls, settings: Any) -> tuple[str, ...]:
        if len(settings.channels) == 1:
            return (settings.measures,)
        return tuple(f"{settings.measures}_{number}" for number in settings.channels)

    @classmethod
    @override
    def traffic_of(
        cls, settings: Any, rate: float, quantities: tuple[str, ...], folder: Path
    ) -> tuple[tuple[int, float], ...]:
        channels = zip(settings.channels, cls.quantities(settings), strict=True)
        objects = [cls._objects(settings, number) for number, quantity in channels if quantity in quantities]
        return (*_map(objects).frames(rate), HEARTBEAT)

    @classmethod
    def _objects(cls, settings: Any, channel: int) -> tuple[MappedObject, MappedObject | None]:
        """Return the objects of value and status of a channel."""
        raise NotImplementedError

    def __init__(self, place: Place, settings: AnalogSettings, profile: int) -> None:
        """Map the channels that the robot file uses.

        Raises:
            ConfigError: An object, a gain or a zero is not valid.
        """
        entries = [
            (slot, position, number)
            for position, (number, quantity) in enumerate(
                zip(settings.channels, self.quantities(settings), strict=True)
            )
            for slot, name in enumerate(place.elements)
            if name == quantity
        ]
        self._channels = [self._channel(place, settings, *entry) for entry in entries]
        self._settings = settings
        super().__init__(place, settings, profile, _map([(c.value, c.status) for c in self._channels]))

    def _channel(self, place: Place, settings: AnalogSettings, slot: int, position: int, number: int) -> Channel:
        value, status = self._objects(settings, number)
        if status is not None and settings.status is None:  # the preset's status is optional
            entry = data_sheet(place.folder / settings.eds).get_variable(status.index, status.subindex)
            status = status if entry is not None and entry.pdo_mappable else None
        gain = _of(settings.gain, settings, position, f"{place}: gain")
        zero = _of(settings.zero, settings, position, f"{place}: zero")
        if gain == 0.0:
            raise ConfigError(f"{place}: a gain of zero would make every value the same.")
        quantity = self.quantities(settings)[position]
        bounds = self._bounds(settings, value)
        return Channel(number, quantity, value, status, slot, zero or 0.0, gain or 1.0, bounds)

    def _bounds(self, settings: Any, value: MappedObject) -> tuple[float, float]:
        """Return the ends of the value's type; a number at or beyond one of them is an overload."""
        if value.kind == "float":
            return -math.inf, math.inf
        if value.kind == "unsigned":
            return -1, (1 << value.bits) - 1
        half = 1 << value.bits - 1
        return -half, half - 1

    @override
    def _pdo_handler(self, pdo: Pdo) -> PdoHandler:
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
        """Keep a value, or NaN if its status, its range, a frozen number or an emergency makes it invalid."""
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
        """Return status bits in words."""
        return f"status {bad:X}h"

    def _troubles(self) -> list[str]:
        """Return the troubles of a device that answers and reports no fault."""
        return [f"{channel.quantity}: {channel.trouble}" for channel in self._channels if channel.trouble]

    @override
    def _running(self) -> tuple[DeviceState, str]:
        troubles = self._troubles()
        return DeviceState.READY, f"{self._place}: {'; '.join(troubles)}." if troubles else ""


def parse(text: str, channel: int, what: str) -> MappedObject:
    """Parse the object of a channel, as `7130h int16` or, with its sub-index, `2120h:0 uint16`.

    Raises:
        ConfigError: The text has another form.
    """
    entry, _, kind = text.strip().partition(" ")
    try:
        item = cia301.mapped(entry, kind.strip())
    except ValueError as error:
        raise ConfigError(f"{what} '{text}': {error} Write an object and its type: 7130h int16.") from None
    return item if ":" in entry else MappedObject(item.index, channel, item.bits, item.kind)


def _of(value: float | tuple[float, ...] | None, settings: AnalogSettings, position: int, what: str) -> float | None:
    """Return the setting of one channel: one number for all channels, or one for each."""
    if not isinstance(value, tuple):
        return value
    if len(value) != len(settings.channels):
        raise ConfigError(f"{what} has {len(value)} numbers for {len(settings.channels)} channels.")
    return value[position]


def _map(channels: Sequence[tuple[MappedObject, MappedObject | None]]) -> PdoMap:
    """Map a channel's value and its own status to one PDO; a status common to all channels to the first PDO."""
    statuses = [status for _, status in channels]
    shared = statuses[0] if statuses and len(channels) > 1 and len(set(statuses)) == 1 else None
    groups = [(value,) if status in (None, shared) else (value, status) for value, status in channels]
    return PdoMap(sends=lay_out([(shared,), *groups] if shared else groups))


INPUT_PRESETS = dict(analog.INPUTS) | {
    # Seneca ZC-SG strain gauge converter, user manual: 6403h:1 is the weight; overload and errors come as EMCY FF10h.
    "zc_sg": analog.INPUTS["float32"],
}


class InputSettings(AnalogSettings):
    """Settings of analogue inputs; `gain` is required: SI units per count (or per unit of the float object)."""

    preset: Literal["int16", "int32", "float32", "zc_sg"] = "int16"
    """Object of the value: 6401h as `int16`, 6402h as `int32`, 6403h as `float32`; or a family of converters."""
    resolution: Annotated[int, Field(ge=2, le=32)] | None = None
    """Bits of the converter, the ends of whose range are overload; absent: the bits of the object."""


class Cia401Input(AnalogNode):
    """Analogue inputs. The device has no unit and no tare; gain and zero replace them."""

    Settings = InputSettings

    @classmethod
    @override
    def _objects(cls, settings: InputSettings, channel: int) -> tuple[MappedObject, MappedObject | None]:
        item = INPUT_PRESETS[settings.preset]
        value = MappedObject(item.index, channel, item.bits, item.kind)
        if settings.value is not None:
            value = parse(settings.value, channel, "value")
        return value, None if settings.status is None else parse(settings.status, channel, "status")

    def __init__(self, place: Place, settings: InputSettings) -> None:
        if settings.gain is None:
            raise ConfigError(f"{place} sends counts. Give `gain`, the {settings.measures} of one count in SI units.")
        super().__init__(place, settings, analog.INPUT_PROFILE)

    @override
    def _bounds(self, settings: Any, value: MappedObject) -> tuple[float, float]:
        low, high = super()._bounds(settings, value)
        bits = settings.resolution
        if bits is None or value.kind == "float" or bits >= value.bits:
            return low, high
        return low, high >> value.bits - bits << value.bits - bits

    @override
    def _calibrate(self) -> None:
        for channel in self._channels:
            channel.scale = 1.0

    @override
    def _writes(self) -> tuple[tuple[MappedObject, int], ...]:
        enable = analog.INTERRUPT_ENABLE
        return ((enable, 1),) if self._sdo.has(enable.index) else ()


log = logging.getLogger(__name__)

COUNTS = "counts"
"""This unit stands for raw counts; `gain` is the value of one count."""


@dataclass(frozen=True, slots=True)
class Preset:
    """Properties of an amplifier that a robot file selects by a name.

    Attributes:
        form: ValueForm of its measured value.
        unit: Unit of its numbers; None: read from the device (6131h).
    """

    form: analog.ValueForm
    unit: str | None = None


CELL_PRESETS = {name: Preset(form, None if form.has_unit else COUNTS) for name, form in analog.FORMS.items()} | {
    # Baumer StrainLink DSRT, manual V3.05, 6.3: 7130h, 6132h, 6150h, 6125h; it sends strain, which `gain` converts.
    "strain_link": Preset(analog.FORMS["int16"], COUNTS),
}
PresetName = Literal["float32", "int16", "int32", "counts16", "counts32", "strain_link"]


class CellSettings(AnalogSettings):
    """Settings of a load cell; by default unit and decimal digits are read from the device."""

    preset: PresetName = "int32"
    """Object of the value: 6130h as `float32`, 7130h as `int16`, 9130h as `int32`, or before any scaling 7100h as
    `counts16`, 9100h as `counts32`; or a family of amplifiers."""
    unit: str | None = None
    """Unit of the device's numbers, in place of that in 6131h: `N`, `kN`, `kg`, `N m`, `bar`, ... `counts`."""
    digits: int | None = None
    """Decimal digits of a whole number, in place of those in 6132h."""


class Cia404Cell(AnalogNode):
    """Channels of a measuring amplifier. A tare that the device loses when it reboots is restored."""

    Settings = CellSettings
    COUNTERS = (*AnalogNode.COUNTERS, "tared")

    @classmethod
    @override
    def _objects(cls, settings: CellSettings, channel: int) -> tuple[MappedObject, MappedObject | None]:
        form = CELL_PRESETS[settings.preset].form
        value, status = (
            MappedObject(item.index, channel, item.bits, item.kind) if item else None
            for item in (form.value, form.status)
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
        """Return the SI units per unit of the device; None if the unit is only known to the device.

        Raises:
            ConfigError: The unit is unknown or of another quantity, or counts have no gain.
        """
        if self._unit is None:
            return None
        if self._unit == COUNTS:
            if settings.gain is None:
                raise ConfigError(f"{place} sends counts. Give `gain`, the {settings.measures} of one count, SI units.")
            return 1.0
        units = [name for name, unit in analog.UNITS.items() if unit.quantity == settings.measures]
        if self._unit not in units:
            raise ConfigError(f"{place}: '{self._unit}' is no unit of {settings.measures}. Known: {', '.join(units)}.")
        return analog.UNITS[self._unit].scale

    @override
    def _calibrate(self) -> None:
        for channel in self._channels:
            channel.scale = self._unit_scale(channel) * 10.0 ** -self._digits(channel)
        for number, offset in self._offsets.items():
            self._sdo.write_checked(analog.OFFSET, number, offset, 4)

    def _unit_scale(self, channel: Channel) -> float:
        if self._fixed is not None:
            return self._fixed
        code = self._sdo.read_twice(analog.UNIT_CODE, channel.number)
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
        return self._sdo.read_twice(analog.DIGITS, channel.number)

    @override
    def tare(self) -> None:
        if not self.is_commissioned:
            raise CommandRefused(f"{self._place} cannot be tared: {self._trouble[1]}")
        self._tare_text = "being tared"
        self.long_request = self._tare

    def _tare(self) -> None:
        """Tare every channel, and keep the offsets to restore them after a reboot."""
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
        """Return the offset that the tare has set, as the bits of a REAL32."""
        bits = self._sdo.read_twice(analog.OFFSET, number)
        if not math.isfinite(struct.unpack("<f", bits.to_bytes(4, "little"))[0]):
            raise DeviceRefused(f"{self._place} reports an offset (6124h:{number}) after the tare that is no number.")
        return bits

    @override
    def _describe(self, bad: int) -> str:
        return analog.describe_status(bad) if self._cell.status is None else super()._describe(bad)

    @override
    def _troubles(self) -> list[str]:
        return [*super()._troubles(), *([self._tare_text] if self._tare_text else [])]
