"""Between a drive's counts, velocity units and thousandths of rated torque, and SI units at the joint or the wire."""

import math
from dataclasses import dataclass

from hal.calibration.line import Linear, rotary, spool
from hal.drivers.cia402.settings import DriveSettings
from hal.protocols.cia402 import VelocityUnit

LARGEST_COUNT = 2**31 - 1
LARGEST_TORQUE = 2**15 - 1


@dataclass(frozen=True, slots=True)
class DriveUnits:
    """What a drive's numbers are worth.

    Attributes:
        position: Counts -> [rad or m].
        velocity: [rad/s or m/s] of one velocity unit; negative if counts grow the other way.
        effort: [N m at the joint, or N at the wire] of a thousandth of the rated torque, in the direction in which the
            position grows: motor torque times gear (over the radius); friction of the gear is not in it. Held by its
            motor, a taut wire has a negative effort, since it would get longer. NaN if the rated torque is not known.
        motor_turn: [rad or m] of one turn of the motor.
    """

    position: Linear
    velocity: float
    effort: float
    motor_turn: float

    def counts(self, value: float) -> int:
        """The nearest target position [counts] for a position [rad or m]."""
        return _clip(self.position.to_counts(value), LARGEST_COUNT)

    def speed(self, value: float) -> int:
        """The nearest target velocity [velocity units] for a velocity [rad/s or m/s]."""
        return _clip(value / self.velocity, LARGEST_COUNT)

    def torque(self, value: float) -> int:
        """The nearest target torque [thousandths of the rated one] for an effort [N m or N]."""
        return _clip(value / self.effort, LARGEST_TORQUE)

    def size(self, value: float, per_unit: float) -> int:
        """A bound, for an object without a sign: at least 1, at most what 31 bits hold."""
        return min(max(round(abs(value / per_unit)), 1), LARGEST_COUNT)


def drive_units(settings: DriveSettings, unit: VelocityUnit, rated_torque: float) -> DriveUnits:
    """The units of one drive.

    Args:
        settings: Its settings.
        unit: Of its velocities.
        rated_torque: Of its motor [N m]; NaN if not known.
    """
    shape = (settings.counts_per_turn, settings.gear, settings.direction, settings.zero)
    radius = settings.spool_radius
    line = spool(*shape, radius) if radius else rotary(*shape)
    return DriveUnits(
        position=line,
        velocity=line.scale * unit.counts_per_second(settings.counts_per_turn),
        effort=settings.direction * rated_torque / 1000 * settings.gear / (radius or 1.0),
        motor_turn=2 * math.pi / settings.gear * (radius or 1.0),
    )


def _clip(value: float, largest: int) -> int:
    return round(min(max(value, -largest), largest))
