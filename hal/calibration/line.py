"""Conversion of counts to SI units and back, and fits of zero, direction and gain to known values."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.config import Section
from hal.errors import HalError


@dataclass(frozen=True, slots=True)
class Calibration:
    """Measured settings of one very device; they are not valid for another device.

    Attributes:
        identity: `Device.identity` of the measured device.
        settings: Settings of its driver, such as `zero` and `direction`, which replace those of the robot file.
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
        """Return the value [SI unit] at a number of counts."""
        return self.zero + self.scale * counts

    def to_counts(self, value: float) -> int:
        """Return the nearest whole number of counts for a value [SI unit]."""
        return round((value - self.zero) / self.scale)


def rotary(counts_per_turn: float, gear: float, direction: int, zero: float) -> Linear:
    """Return the line of a joint [rad] with an encoder before a gear of `gear` motor turns per joint turn."""
    return Linear(zero, direction * 2.0 * math.pi / (counts_per_turn * gear))


def spool(counts_per_turn: float, gear: float, direction: int, zero: float, radius: float) -> Linear:
    """Return the line of a wire [m] on a spool of `radius` [m] behind a gear as in `rotary`."""
    return Linear(zero, rotary(counts_per_turn, gear, direction, 0.0).scale * radius)


SCALE_TOLERANCE = 0.1
"""The measured motion of a joint may differ by this share from the known one. A wrong gear or count causes more, a
motion by hand less."""
RESIDUAL_SHARE = 0.02
"""The residual of a load cell may have this share of the span of its weights."""


class Point(Section):
    """Mean reading of a device at a known value.

    Both have the signal's unit. The reading is with `zero` 0 and a `gain` or `direction` of 1.
    """

    known: float
    read: float
    std: float
    samples: int


class CalibrationRefused(HalError):
    """A measurement that does not allow a calibration."""


@dataclass(frozen=True, slots=True)
class CalibrationLine:
    """The line value = zero + factor * reading.

    Attributes:
        zero: Value at a reading of 0 [the signal's unit].
        factor: -1 or 1 for a joint, any number but 0 for a cell.
        residual: Largest difference at the points [the signal's unit].
    """

    zero: float
    factor: float
    residual: float

    def value(self, read: float) -> float:
        """Return the calibrated value [the signal's unit] of the reading `read`."""
        return self.zero + self.factor * read


def joint_line(points: Sequence[Point], direction: float, least: float) -> CalibrationLine:
    """Fit the zero to one known position, zero and direction to two or more.

    Args:
        points: At least one point.
        direction: Direction if there is only one point, -1 or 1.
        least: Smallest difference of the positions [the signal's unit] for a fit of the direction.

    Raises:
        CalibrationRefused: The positions do not differ, or the measured motion differs from the known one.
    """
    known, read = _columns(points)
    if len(points) > 1:
        if np.ptp(known) < least:
            raise CalibrationRefused(f"The positions differ by {np.ptp(known):.3g}; move by at least {least:g}.")
        if np.ptp(read) < 0.2 * least:
            raise CalibrationRefused(
                f"The device read the same at positions that differ by {np.ptp(known):.3g}. Is it the device of this "
                "joint, is it coupled to the joint?"
            )
        slope = float(np.polyfit(read, known, 1)[0])
        direction = 1.0 if slope > 0 else -1.0
        if abs(abs(slope) - 1.0) > SCALE_TOLERANCE:
            raise CalibrationRefused(
                f"The joint moved by {np.ptp(known):.4g}, the device read {np.ptp(read):.4g}: counts per turn "
                f"times gear, or the radius, are wrong by a factor of {1.0 / abs(slope):.3g}."
            )
    zero = float(np.mean(known - direction * read))
    return CalibrationLine(zero, direction, _residual(known, zero + direction * read))


def cell_line(points: Sequence[Point], gain: float, noise: float) -> CalibrationLine:
    """Fit the zero to one known force, zero and gain to two or more.

    Args:
        points: At least one point.
        gain: Gain if there is only one point.
        noise: Noise of a value [the signal's unit].

    Raises:
        CalibrationRefused: The forces do not differ, the cell does not measure them, or they are not on a line.
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
                "cell hang freely, was each weight given correctly?"
            )
    zero = float(np.mean(known - gain * read))
    return CalibrationLine(zero, gain, _residual(known, zero + gain * read))


def _columns(points: Sequence[Point]) -> tuple[np.ndarray, np.ndarray]:
    """Return known values and readings, shape (n,) each."""
    return np.array([point.known for point in points]), np.array([point.read for point in points])


def _residual(known: np.ndarray, fit: np.ndarray) -> float:
    return float(np.max(np.abs(known - fit)))
