"""Load cells behind plain converters: CiA 401 analogue inputs, whose counts become newtons by gain and zero."""

from typing import Annotated, Any, Literal

from pydantic import Field

from hal.drivers.can_device import Place
from hal.drivers.canopen.analog import AnalogNode, AnalogSettings, parse
from hal.errors import ConfigError
from hal.protocols import cia401
from hal.protocols.cia301 import Mapped

PRESETS = dict(cia401.INPUTS) | {
    # Seneca ZC-SG strain gauge converter, user manual: 6403h:1 is the weight; overload and errors come as EMCY FF10h.
    "zc_sg": cia401.INPUTS["float32"],
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
        item = PRESETS[settings.preset]
        value = Mapped(item.index, channel, item.bits, item.kind)
        if settings.value is not None:
            value = parse(settings.value, channel, "value")
        return value, None if settings.status is None else parse(settings.status, channel, "status")

    def __init__(self, place: Place, settings: InputSettings) -> None:
        if settings.gain is None:
            raise ConfigError(f"{place} tells counts. Give `gain`, the {settings.measures} of one count in SI units.")
        super().__init__(place, settings, cia401.PROFILE)

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
        enable = cia401.INTERRUPT_ENABLE
        return ((enable, 1),) if self._sdo.has(enable.index) else ()
