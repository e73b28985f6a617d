"""Counts to SI units and back, and what was measured of one device."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Calibration:
    """What was measured of one very device; it belongs to that device and no other.

    Attributes:
        identity: `Device.identity` of the device that was measured.
        settings: Settings of its driver, such as `zero` and `direction`, to be laid over those of the robot file.
    """

    identity: str
    settings: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Linear:
    """A straight line through a known point.

    Attributes:
        zero: Value at zero counts [SI unit].
        scale: Value of one count [SI unit]; negative if the counts grow the other way.
    """

    zero: float
    scale: float

    def to_si(self, counts: float) -> float:
        """Value [SI unit] at so many counts."""
        return self.zero + self.scale * counts

    def to_counts(self, value: float) -> int:
        """Nearest whole number of counts for a value [SI unit]."""
        return round((value - self.zero) / self.scale)


def rotary(counts_per_turn: float, gear: float, direction: int, zero: float) -> Linear:
    """A joint [rad] whose encoder sits before a gear of `gear` motor turns per joint turn."""
    return Linear(zero, direction * 2.0 * math.pi / (counts_per_turn * gear))


def spool(counts_per_turn: float, gear: float, direction: int, zero: float, radius: float) -> Linear:
    """A wire [m] wound on a spool of `radius` [m] behind such a gear."""
    return Linear(zero, rotary(counts_per_turn, gear, direction, 0.0).scale * radius)
