"""An absolute encoder on a joint [rad]."""

import math
from typing import Literal

from hal import calibration
from hal.commissioning import Plan
from hal.config import Finite, Positive
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen_node import HEARTBEAT, CanopenNode, NodeSettings
from hal.errors import DeviceRefused
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
        super().__init__(place, settings)
        self._settings = settings
        self._zero = settings.zero
        self._scale = math.nan
        self._alarms = 0

    def _plan(self) -> Plan:
        return Plan(cia406.PROFILE, (), cia406.VALUE)

    def _calibrate(self) -> None:
        counts = self._settings.counts_per_turn
        if counts is None:
            counts = self._sdo.read(cia406.MEASURING_UNITS.index, cia406.MEASURING_UNITS.subindex)
        if not counts:
            raise DeviceRefused(f"{self._place} says that it has no counts per turn (6001h). Give counts_per_turn.")
        self._scale = calibration.rotary(counts, 1.0, self._settings.direction, self._zero).scale

    def _on_tpdo(self, data: bytearray, received: float) -> None:
        if len(data) != 6:
            self._counters["malformed"] += 1
            return
        if not self.is_commissioned:
            return
        counts, self._alarms = cia406.VALUE_LAYOUT.unpack(data)
        good = not self._alarms and not self._emergency
        self._answered(self._zero + self._scale * counts if good else math.nan, received)

    def _running(self) -> tuple[DeviceState, str]:
        if self._alarms:
            return DeviceState.READY, f"{self._place}: {cia406.describe_alarms(self._alarms)}."
        return DeviceState.READY, ""
