"""From what a device read while the truth was known, to the settings that make it read the truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hal.calibration.store import Point
from hal.errors import HalError

SCALE_TOLERANCE = 0.1
"""How far a joint's change may be from what was told; a wrong gear or count is off by more, a hand by less."""
RESIDUAL_SHARE = 0.02
"""Largest residual of a load cell as a share of the span of its weights."""


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
