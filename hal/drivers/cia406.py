"""An absolute encoder on a joint [rad]."""

import math
from typing import Literal

from hal import calibration
from hal.config import Finite, Positive
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen_node import HEARTBEAT, CanopenNode, NodeSettings, Taker
from hal.errors import DeviceRefused
from hal.pdo_map import Pdo, PdoMap, lay_out
from hal.protocols import cia406


class EncoderSettings(NodeSettings):
    """Settings of an encoder."""

    counts_per_turn: Positive | None = None
    """Counts per turn of the joint; absent: what the device says in object 6001h."""
    direction: Literal[1, -1] = 1
    """1 if counts grow with the angle, else -1."""
    zero: Finite = 0.0
    """Angle at zero counts [rad]."""


class Cia406Encoder(CanopenNode):
    """One encoder. A position with an alarm, or during an emergency, is NaN."""

    Settings = EncoderSettings

    @classmethod
    def quantities(cls, settings: EncoderSettings) -> tuple[str, ...]:
        """See `CanDevice.quantities`."""
        return ("position",)

    @classmethod
    def traffic(cls, settings: EncoderSettings, rate: float) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic`."""
        return ((cia406.VALUE_LAYOUT.size, rate), HEARTBEAT)

    def __init__(self, place: Place, settings: EncoderSettings) -> None:
        super().__init__(place, settings, cia406.PROFILE, PdoMap(sends=lay_out(cia406.VALUE)))
        self._settings = settings
        self._zero = settings.zero
        self._scale = math.nan
        self._alarms = 0

    def _calibrate(self) -> None:
        counts = self._settings.counts_per_turn
        if counts is None:
            counts = self._sdo.read(cia406.MEASURING_UNITS.index, cia406.MEASURING_UNITS.subindex)
        if not counts:
            raise DeviceRefused(f"{self._place} says that it has no counts per turn (6001h). Give counts_per_turn.")
        self._scale = calibration.rotary(counts, 1.0, self._settings.direction, self._zero).scale

    def _taker(self, pdo: Pdo) -> Taker:
        return self._take

    def _take(self, values: tuple[int, int], received: float) -> None:
        counts, self._alarms = values
        good = not self._alarms and not self._emergency
        self._keep(0, self._zero + self._scale * counts if good else math.nan, received)

    def _running(self) -> tuple[DeviceState, str]:
        if self._alarms:
            return DeviceState.READY, f"{self._place}: {cia406.describe_alarms(self._alarms)}."
        return DeviceState.READY, ""
