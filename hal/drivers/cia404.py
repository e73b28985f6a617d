"""A load cell: the force [N] in a wire."""

import math

from hal.config import Finite
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen_node import HEARTBEAT, CanopenNode, NodeSettings, Taker
from hal.errors import DeviceRefused
from hal.pdo_map import Pdo, PdoMap, lay_out
from hal.protocols import cia404


class CellSettings(NodeSettings):
    """Settings of a load cell; unit and decimal digits are read from the device."""

    zero: Finite = 0.0
    """Added to what the cell reads [N]."""


class Cia404Cell(CanopenNode):
    """One load cell. A value whose status is not good, or during an emergency, is NaN."""

    Settings = CellSettings

    @classmethod
    def quantities(cls, settings: CellSettings) -> tuple[str, ...]:
        """See `CanDevice.quantities`."""
        return ("force",)

    @classmethod
    def traffic(cls, settings: CellSettings, rate: float) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic`."""
        return ((cia404.VALUE_LAYOUT.size, rate), HEARTBEAT)

    def __init__(self, place: Place, settings: CellSettings) -> None:
        super().__init__(place, settings, cia404.PROFILE, PdoMap(sends=lay_out(cia404.VALUE)))
        self._zero = settings.zero
        self._scale = math.nan
        self._status = 0

    def _calibrate(self) -> None:
        unit = self._sdo.read(cia404.UNIT.index, cia404.UNIT.subindex)
        digits = self._sdo.read(cia404.DIGITS.index, cia404.DIGITS.subindex)
        scale = cia404.newtons_per_digit(unit, digits)
        if scale is None:
            raise DeviceRefused(f"{self._place} measures in unit {unit:08X}h (6131h), which is no force.")
        self._scale = scale

    def _taker(self, pdo: Pdo) -> Taker:
        return self._take

    def _take(self, values: tuple[int, int], received: float) -> None:
        digits, self._status = values
        good = not self._status and not self._emergency
        self._keep(0, self._zero + self._scale * digits if good else math.nan, received)

    def _running(self) -> tuple[DeviceState, str]:
        if self._status:
            return DeviceState.READY, f"{self._place}: {cia404.describe_status(self._status)}."
        return DeviceState.READY, ""
