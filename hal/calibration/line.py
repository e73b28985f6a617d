"""Counts to SI units and back, and fits of zero, direction and gain to known values."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.config import Section
from hal.errors import HalError


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


SCALE_TOLERANCE = 0.1
"""How far a joint's change may be from what was told; a wrong gear or count is off by more, a hand by less."""
RESIDUAL_SHARE = 0.02
"""Largest residual of a load cell as a share of the span of its weights."""


class Point(Section):
    """What a device read while the truth was known.

    Both are in the signal's unit; what was read is without `zero`, and with a `gain` or `direction` of 1.
    """

    known: float
    read: float
    std: float
    samples: int


class CalibrationRefused(HalError):
    """What was measured is no ground for a calibration."""


@dataclass(frozen=True, slots=True)
class Line:
    """value = zero + factor * what the device reads.

    Attributes:
        zero: [the signal's unit].
        factor: -1 or 1 for a joint, anything but 0 for a cell.
        residual: Largest difference at the points [the signal's unit].
    """

    zero: float
    factor: float
    residual: float

    def value(self, read: float) -> float:
        """What the calibrated device tells [the signal's unit] where it read `read`."""
        return self.zero + self.factor * read


def joint_line(points: Sequence[Point], direction: float, least: float) -> Line:
    """Zero from one known position, zero and direction from two or more.

    Args:
        points: At least one.
        direction: What to keep with one point, -1 or 1.
        least: By how much [the signal's unit] positions must differ to tell a direction.

    Raises:
        CalibrationRefused: The positions do not differ, or the joint moved by another angle than was told.
    """
    known, read = _columns(points)
    if len(points) > 1:
        if np.ptp(known) < least:
            raise CalibrationRefused(f"The positions differ by {np.ptp(known):.3g}; move by at least {least:g}.")
        if np.ptp(read) < 0.2 * least:
            raise CalibrationRefused(
                f"The device read the same at positions that differ by {np.ptp(known):.3g}. Is it the device of this "
                "joint, is it coupled to it?"
            )
        slope = float(np.polyfit(read, known, 1)[0])
        direction = 1.0 if slope > 0 else -1.0
        if abs(abs(slope) - 1.0) > SCALE_TOLERANCE:
            raise CalibrationRefused(
                f"The joint moved by {np.ptp(known):.4g}, the device read {np.ptp(read):.4g}: counts per turn "
                f"times gear, or the radius, are wrong by a factor of {1.0 / abs(slope):.3g}."
            )
    zero = float(np.mean(known - direction * read))
    return Line(zero, direction, _residual(known, zero + direction * read))


def cell_line(points: Sequence[Point], gain: float, noise: float) -> Line:
    """Zero from one known force, zero and gain from two or more.

    Args:
        points: At least one.
        gain: What to keep with one point.
        noise: By how much [the signal's unit] a value may be off anyway.

    Raises:
        CalibrationRefused: The forces do not differ, the cell does not feel them, or they are not on a line.
    """
    known, read = _columns(points)
    if len(points) > 1:
        span = float(np.ptp(known))
        if span < 10 * noise:
            raise CalibrationRefused(
                f"The weights differ by {span:.3g} N, which is not ten times the noise of {noise:.3g} N. Use others."
            )
        if np.ptp(read) <= 6 * max(point.std for point in points):
            raise CalibrationRefused(
                f"The cell read the same, within its noise, at weights that differ by {span:.3g} N. Do they hang on it?"
            )
        gain, zero = (float(value) for value in np.polyfit(read, known, 1))
        residual = _residual(known, zero + gain * read)
        if residual > RESIDUAL_SHARE * span + 3 * noise:
            raise CalibrationRefused(
                f"The points are not on a line: the largest residual is {residual:.3g} N of {span:.3g} N. Does the "
                "cell hang freely, was each weight told right?"
            )
    zero = float(np.mean(known - gain * read))
    return Line(zero, gain, _residual(known, zero + gain * read))


def _columns(points: Sequence[Point]) -> tuple[np.ndarray, np.ndarray]:
    """Known and read values, shape (n,) each."""
    return np.array([point.known for point in points]), np.array([point.read for point in points])


def _residual(known: np.ndarray, told: np.ndarray) -> float:
    return float(np.max(np.abs(known - told)))
