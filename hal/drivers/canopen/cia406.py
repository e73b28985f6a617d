"""An absolute encoder on a joint: position [rad], and velocity [rad/s] where it tells that."""

import math
from typing import Any, Literal

from hal.commissioning.pdo_map import Pdo, PdoMap, lay_out
from hal.config import Finite, Positive
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen.node import HEARTBEAT, CanopenNode, NodeSettings, Taker, data_sheet
from hal.errors import DeviceRefused
from hal.protocols import cia406
from hal.protocols.cia301 import PDO_SIZE, Mapped

_SPEED_END = 2**15 - 1


class EncoderSettings(NodeSettings):
    """Settings of an encoder."""

    counts_per_turn: Positive | None = None
    """Counts per turn of the joint; absent: per turn of the encoder, as the device says."""
    direction: Literal[1, -1] = 1
    """1 if counts grow with the angle, else -1."""
    zero: Finite = 0.0
    """Angle at zero counts [rad]."""
    around: Finite | None = None
    """The angle is told within half the encoder's range of this one [rad], wherever its counts begin again; absent:
    from `zero` on."""


class Cia406Encoder(CanopenNode):
    """One encoder. A position with an alarm, or during an emergency, is NaN; so is a speed at the end of its range."""

    Settings = EncoderSettings

    @classmethod
    def quantities(cls, settings: EncoderSettings) -> tuple[str, ...]:
        """See `CanDevice.quantities`."""
        return ("position", "velocity")

    @classmethod
    def traffic(cls, settings: EncoderSettings, rate: float) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic`; position and alarms, and room for speed or warnings."""
        return ((PDO_SIZE, rate), HEARTBEAT)

    def __init__(self, place: Place, settings: EncoderSettings) -> None:
        self._scale = self._range = self._speed_scale = math.nan
        self._alarms = self._warnings = 0
        self._is_outside = False
        self._settings = settings
        sheet = data_sheet(place.folder / settings.eds)
        wanted = [cia406.POSITION]
        extra = cia406.SPEED if "velocity" in place.elements else cia406.WARNINGS
        for item in (cia406.ALARMS, extra):
            entry = sheet.get_variable(item.index, item.subindex)
            if item is cia406.SPEED or (entry is not None and entry.pdo_mappable):
                wanted.append(item)
        super().__init__(place, settings, cia406.PROFILE, PdoMap(sends=lay_out(wanted)))

    def _calibrate(self) -> None:
        """Read what one turn is, and after how many counts they begin again."""
        scaled = self._optional(cia406.OPERATING_PARAMETERS) & cia406.SCALING_ON
        if scaled:
            per_turn, total = self._optional(cia406.UNITS_PER_TURN), self._optional(cia406.TOTAL_UNITS)
        else:
            per_turn = self._optional(cia406.PHYSICAL_PER_TURN)
            total = per_turn * self._optional(cia406.PHYSICAL_TURNS)
        counts = self._settings.counts_per_turn or per_turn
        if not counts:
            raise DeviceRefused(f"{self._place} does not say what one turn is (6001h, 6501h). Give counts_per_turn.")
        if not total and self._settings.around is not None:
            raise DeviceRefused(f"{self._place} does not say how many turns it tells apart (6502h). Drop `around`.")
        size = 2.0 * math.pi / counts
        self._scale = self._settings.direction * size
        self._range = total * size or math.inf
        multiplier = self._optional(cia406.SPEED_MULTIPLIER) or 1
        self._speed_scale = self._scale * (self._optional(cia406.SPEED_DIVIDER) or 1) / multiplier

    def _optional(self, item: Mapped) -> int:
        """The value of an object; 0 if the data sheet does not have it."""
        return self._sdo.read(item.index, item.subindex) if self._sdo.has(item.index, item.subindex) else 0

    def _taker(self, pdo: Pdo) -> Taker:
        places = {item: place for place, item in enumerate(pdo.objects)}
        position, speed = places.get(cia406.POSITION), places.get(cia406.SPEED)
        alarms, warnings = places.get(cia406.ALARMS), places.get(cia406.WARNINGS)
        angle_slot, speed_slot = self._slots.get("position"), self._slots.get("velocity")

        def take(objects: tuple[Any, ...], received: float) -> None:
            if alarms is not None:
                self._alarms = objects[alarms]
            if warnings is not None:
                self._warnings = objects[warnings]
            good = not (self._alarms or self._emergency or self._twin)
            if position is not None and angle_slot is not None:
                self._keep(angle_slot, self._angle(objects[position]) if good else math.nan, received)
            if speed is not None and speed_slot is not None:
                found = objects[speed]
                inside = good and -_SPEED_END < found < _SPEED_END
                self._keep(speed_slot, self._speed_scale * found if inside else math.nan, received)

        return take

    def _angle(self, counts: int) -> float:
        """Angle of the joint [rad]; NaN for counts that the encoder cannot have."""
        settings, whole = self._settings, self._range
        self._is_outside = counts * abs(self._scale) >= whole
        if self._is_outside:
            return math.nan
        angle = settings.zero + self._scale * counts
        if settings.around is None:
            return angle
        return settings.around + (angle - settings.around + 0.5 * whole) % whole - 0.5 * whole

    def _running(self) -> tuple[DeviceState, str]:
        text = ""
        if self._alarms:
            text = cia406.describe_alarms(self._alarms)
        elif self._is_outside:
            text = "counts beyond its own range; was its scaling changed? Open it again"
        elif self._warnings:
            text = f"warns: {cia406.describe_warnings(self._warnings)}"
        return DeviceState.READY, f"{self._place}: {text}." if text else ""
