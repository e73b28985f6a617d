"""Load cells with a measuring amplifier: the force [N] in a wire; also torque [N m] and pressure [Pa]."""

import logging
import math
import struct
from dataclasses import dataclass
from typing import Literal

from hal.drivers.can_device import Place
from hal.drivers.canopen.analog import AnalogNode, AnalogSettings, Channel, parse
from hal.errors import CommandRefused, ConfigError, DeviceRefused, HalError
from hal.protocols import cia303, cia404
from hal.protocols.cia301 import Mapped

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

    form: cia404.Form
    unit: str | None = None


PRESETS = {name: Preset(form, None if form.has_unit else COUNTS) for name, form in cia404.FORMS.items()} | {
    # Baumer StrainLink DSRT, manual V3.05, 6.3: 7130h, 6132h, 6150h, 6125h; it tells strain, which gain makes a force.
    "strain_link": Preset(cia404.FORMS["int16"], COUNTS),
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
        form = PRESETS[settings.preset].form
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
        self._unit = settings.unit or PRESETS[settings.preset].unit
        self._fixed = self._known_unit(place, settings)
        self._cell = settings
        self._offsets: dict[int, int] = {}
        self._tare_text = ""
        super().__init__(place, settings, cia404.PROFILE)

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
        known = [name for name, unit in cia303.UNITS.items() if unit.quantity == settings.measures]
        if self._unit not in known:
            raise ConfigError(f"{place}: '{self._unit}' is no unit of {settings.measures}. Known: {', '.join(known)}.")
        return cia303.UNITS[self._unit].scale

    def _calibrate(self) -> None:
        for channel in self._channels:
            channel.scale = self._unit_scale(channel) * 10.0 ** -self._digits(channel)
        for number, offset in self._offsets.items():
            self._sdo.write_checked(cia404.OFFSET, number, offset, 4)

    def _unit_scale(self, channel: Channel) -> float:
        if self._fixed is not None:
            return self._fixed
        code = self._sdo.read(cia404.UNIT, channel.number)
        unit = cia303.unit(code)
        if unit is None or unit.quantity != self._settings.measures:
            raise DeviceRefused(
                f"{self._place} measures in unit {code:08X}h (6131h:{channel.number}), which is no "
                f"{self._settings.measures}. Is it the right device? If the unit is wrong, give `unit`."
            )
        return unit.scale

    def _digits(self, channel: Channel) -> int:
        if self._cell.digits is not None:
            return self._cell.digits
        if not PRESETS[self._cell.preset].form.has_digits or channel.value.kind == "float":
            return 0
        return self._sdo.read(cia404.DIGITS, channel.number)

    def tare(self) -> None:
        """See `Device.tare`; `health` tells what came of it, and counts it as `tared`."""
        if not self.is_commissioned:
            raise CommandRefused(f"{self._place} cannot be tared: {self._trouble[1]}")
        self._tare_text = "being tared"
        self.errand = self._tare

    def _tare(self) -> None:
        """Have every channel take what it measures as zero, and remember what it takes to do so again."""
        try:
            for channel in self._channels:
                self._sdo.write(cia404.AUTOZERO, channel.number, cia404.ZERO, 4)
                if self._sdo.has(cia404.OFFSET, channel.number):
                    self._offsets[channel.number] = self._offset(channel.number)
        except HalError as error:
            self._tare_text = f"not tared: {str(error).rstrip('.')}"
            return
        self._tare_text = ""
        self._counters["tared"] += 1
        log.info("%s is tared", self._place)

    def _offset(self, number: int) -> int:
        """What the tare has set, as the bits of a REAL32."""
        bits = self._sdo.read(cia404.OFFSET, number)
        if not math.isfinite(struct.unpack("<f", bits.to_bytes(4, "little"))[0]):
            raise DeviceRefused(f"{self._place} says after the tare that its offset (6124h:{number}) is no number.")
        return bits

    def _describe(self, bad: int) -> str:
        return cia404.describe_status(bad) if self._cell.status is None else super()._describe(bad)

    def _troubles(self) -> list[str]:
        return [*super()._troubles(), *([self._tare_text] if self._tare_text else [])]
