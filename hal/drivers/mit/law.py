"""The conversion between set-points of a joint or wire and the commands of a motor in MIT mode."""

import math

from hal.drivers.can_device import Place
from hal.drivers.mit.settings import MitSettings
from hal.errors import ConfigError
from hal.protocols.mit import POSITION_TOP, TOP, Command

Counts = tuple[int, int, int]
"""Position, velocity and torque of the motor [counts of its answer]."""


class Law:
    """Gear, gains, largest effort, and the ramp of the stiffness after enabling."""

    def __init__(self, place: Place, settings: MitSettings) -> None:
        """Prepare for one drive.

        Raises:
            ConfigError: The limits in the robot file exceed the range of the motor's frames.
        """
        self.scale, self.zero = settings.scale, settings.zero
        self.ranges = ranges = settings.actuator[1]
        self.lines = (
            (2 * self.scale * ranges.position / POSITION_TOP, self.zero - self.scale * ranges.position),
            (2 * self.scale * ranges.velocity / TOP, -self.scale * ranges.velocity),
            (2 / self.scale * ranges.effort / TOP, -ranges.effort / self.scale),
        )
        """Slope and offset of position, velocity and effort [unit of the element] as functions of counts."""
        self.damping = settings.damping * self.scale**2
        self._mode = settings.mode
        self._stiffness = settings.stiffness * self.scale**2
        self._ramp_cycles = max(1, round(settings.ramp * place.rate))
        self._ramped = 0
        self._is_limited = settings.max_effort is not None
        most = settings.max_effort * abs(self.scale) if settings.max_effort else math.inf
        self._most = min(most, self.ranges.effort)
        self._check_limits(place, settings.motor)
        self.compliance = abs(self.scale) * self._most / self._stiffness if self._mode == "position" else 0.0
        """Distance from the set-point at which the drive pushes with its largest effort [rad or m]; else 0."""

    def _check_limits(self, place: Place, motor: str) -> None:
        scale, ranges = self.scale, self.ranges
        if self._mode == "position":
            ends = (self.zero - scale * ranges.position, self.zero + scale * ranges.position)
        elif self._mode == "velocity":
            ends = (-scale * ranges.velocity, scale * ranges.velocity)
        else:
            ends = (-ranges.effort / scale, ranges.effort / scale)
        low, high = place.bounds
        if not min(ends) <= low < high <= max(ends):
            element = place.elements[self._mode]
            raise ConfigError(
                f"{place}: with this gear and zero, the frames of motor '{motor}' carry a {self._mode} from "
                f"{min(ends):.4g} to {max(ends):.4g}, but the limits of '{element}' are {low:g} to {high:g}. It would "
                f"stop at the end of its range, or jump to the other. Narrow limits.{element.partition('.')[0]}."
            )

    def restart(self) -> None:
        """Start the ramp of the stiffness at 0 again."""
        self._ramped = 0

    def resting(self, counts: Counts | None) -> Command:
        """Return a command without torque, at the motor's present position."""
        return Command(self._motor(counts)[0], 0.0, 0.0, 0.0, 0.0)

    def braking(self) -> Command:
        """Return a command that resists motion without holding a position."""
        return Command(0.0, 0.0, 0.0, self.damping, 0.0)

    def set_point(self, value: float, counts: Counts | None) -> Command:
        """Return the command of a set-point.

        Args:
            value: Set-point [unit of the commanded element].
            counts: Newest answer; the effort of stiffness or damping from there is kept below `max_effort`.
        """
        most = self._most
        if self._mode == "effort":
            return Command(0.0, 0.0, 0.0, 0.0, min(max(value * self.scale, -most), most))
        if self._mode == "velocity":
            speed = value / self.scale
            if self._is_limited:
                now, reach = self._motor(counts)[1], most / self.damping
                speed = min(max(speed, now - reach), now + reach)
            return Command(0.0, speed, 0.0, self.damping, 0.0)
        self._ramped = min(self._ramped + 1, self._ramp_cycles)
        stiffness = self._stiffness * self._ramped / self._ramp_cycles
        angle = (value - self.zero) / self.scale
        if self._is_limited:
            now, reach = self._motor(counts)[0], most / stiffness
            angle = min(max(angle, now - reach), now + reach)
        return Command(angle, 0.0, stiffness, self.damping, 0.0)

    def _motor(self, counts: Counts | None) -> tuple[float, float]:
        """Return position [rad] and velocity [rad/s] of the motor; zero before its first answer."""
        if counts is None:
            return 0.0, 0.0
        ranges = self.ranges
        return (
            counts[0] * 2 * ranges.position / POSITION_TOP - ranges.position,
            counts[1] * 2 * ranges.velocity / TOP - ranges.velocity,
        )
