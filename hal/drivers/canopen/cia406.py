"""An absolute encoder on a joint: position [rad], and velocity [rad/s] if the encoder measures it."""

import math
from typing import Any, Literal

from typing_extensions import override

from hal.calibration.units import axis_units
from hal.commissioning.pdo_map import Pdo, PdoMap, lay_out
from hal.config import Finite, Positive
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen.node import HEARTBEAT, CanopenNode, NodeSettings, PdoHandler, data_sheet
from hal.errors import DeviceRefused
from hal.protocols import cia406
from hal.protocols.cia301 import PDO_SIZE, MappedObject

_SPEED_END = 2**15 - 1


class EncoderSettings(NodeSettings):
    """Settings of an encoder."""

    counts_per_turn: Positive | None = None
    """Counts per turn of the joint; absent: those per turn of the encoder, read from the device."""
    direction: Literal[1, -1] = 1
    """1 if counts grow with the angle, else -1."""
    zero: Finite = 0.0
    """Angle at zero counts [rad]."""
    around: Finite | None = None
    """Center of the reported angles [rad], which extend by half the encoder's range to each side; absent: they start at
    `zero`."""


class Cia406Encoder(CanopenNode):
    """One encoder. A position with an alarm, or during an emergency, is NaN; so is a speed at the end of its range."""

    Settings = EncoderSettings

    @classmethod
    @override
    def quantities(cls, settings: EncoderSettings) -> tuple[str, ...]:
        return ("position", "velocity")

    @classmethod
    @override
    def unit_of(cls, settings: EncoderSettings, quantity: str) -> str | None:
        return axis_units(False).get(quantity)

    @classmethod
    @override
    def traffic(cls, settings: EncoderSettings, rate: float) -> tuple[tuple[int, float], ...]:
        return ((PDO_SIZE, rate), HEARTBEAT)  # position, alarms, and speed or warnings

    def __init__(self, place: Place, settings: EncoderSettings) -> None:
        self._scale = self._range = self._speed_scale = math.nan
        self._alarms = self._warnings = 0
        self._is_outside = False
        self._settings = settings
        sheet = data_sheet(place.folder / settings.eds)
        objects = [cia406.POSITION]
        extra = cia406.SPEED if "velocity" in place.elements else cia406.WARNINGS
        for item in (cia406.ALARMS, extra):
            entry = sheet.get_variable(item.index, item.subindex)
            if item is cia406.SPEED or (entry is not None and entry.pdo_mappable):
                objects.append(item)
        super().__init__(place, settings, cia406.PROFILE, PdoMap(sends=lay_out(objects)))

    @override
    def _calibrate(self) -> None:
        scaled = self._optional(cia406.OPERATING_PARAMETERS) & cia406.SCALING_ON
        if scaled:
            per_turn, total = self._optional(cia406.UNITS_PER_TURN), self._optional(cia406.TOTAL_UNITS)
        else:
            per_turn = self._optional(cia406.PHYSICAL_PER_TURN)
            total = per_turn * self._optional(cia406.PHYSICAL_TURNS)
        counts = self._settings.counts_per_turn or per_turn
        if not counts:
            raise DeviceRefused(f"{self._place} does not report counts per turn (6001h, 6501h). Give counts_per_turn.")
        if not total and self._settings.around is not None:
            raise DeviceRefused(f"{self._place} does not report its number of turns (6502h). Remove `around`.")
        size = 2.0 * math.pi / counts
        self._scale = self._settings.direction * size
        self._range = total * size or math.inf
        multiplier = self._optional(cia406.SPEED_MULTIPLIER) or 1
        self._speed_scale = self._scale * (self._optional(cia406.SPEED_DIVIDER) or 1) / multiplier

    def _optional(self, item: MappedObject) -> int:
        """Return the value of an object; 0 if the data sheet does not have it."""
        return self._sdo.read_twice(item.index, item.subindex) if self._sdo.has(item.index, item.subindex) else 0

    @override
    def _pdo_handler(self, pdo: Pdo) -> PdoHandler:
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
                counts = objects[speed]
                inside = good and -_SPEED_END < counts < _SPEED_END
                self._keep(speed_slot, self._speed_scale * counts if inside else math.nan, received)

        return take

    def _angle(self, counts: int) -> float:
        """Return the angle of the joint [rad]; NaN for counts beyond the encoder's range."""
        settings, whole = self._settings, self._range
        self._is_outside = counts * abs(self._scale) >= whole
        if self._is_outside:
            return math.nan
        angle = settings.zero + self._scale * counts
        if settings.around is None:
            return angle
        return settings.around + (angle - settings.around + 0.5 * whole) % whole - 0.5 * whole

    @override
    def _running(self) -> tuple[DeviceState, str]:
        text = ""
        if self._alarms:
            text = cia406.describe_alarms(self._alarms)
        elif self._is_outside:
            text = "counts beyond its own range; was its scaling changed? Open it again"
        elif self._warnings:
            text = f"warns: {cia406.describe_warnings(self._warnings)}"
        return DeviceState.READY, f"{self._place}: {text}." if text else ""
