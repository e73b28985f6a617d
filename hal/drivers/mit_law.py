"""From set-points of a joint or wire to what a motor in MIT mode is sent, and back."""

import math

from hal.drivers.can_device import Place
from hal.drivers.mit_settings import MitSettings
from hal.errors import ConfigError

Asked = tuple[float, float, float, float, float]
"""Position [rad], velocity [rad/s], stiffness [N m/rad], damping [N m s/rad] and torque [N m] of the motor."""


class Law:
    """Gear, gains, largest effort, and the stiffness that grows after being enabled."""

    def __init__(self, place: Place, settings: MitSettings) -> None:
        """Prepare for one drive.

        Raises:
            ConfigError: The robot file's limits do not fit into the range of the motor's frames.
        """
        self.scale, self.zero = settings.scale, settings.zero
        self.ranges = settings.actuator[1]
        self.damping = settings.damping * self.scale**2
        self._mode = settings.mode
        self._stiffness = settings.stiffness * self.scale**2
        self._ramp_cycles = max(1, round(settings.ramp * place.rate))
        self._ramped = 0
        self._is_limited = settings.max_effort is not None
        most = settings.max_effort * abs(self.scale) if settings.max_effort else math.inf
        self._most = min(most, self.ranges.effort)
        self._check_limits(place, settings.motor)

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
                f"{min(ends):.4g} to {max(ends):.4g}, and the limits of '{element}' are {low:g} to {high:g}. It would "
                f"stop at the end of its range, or start again at the other. Narrow limits.{element.partition('.')[0]}."
            )

    def restart(self) -> None:
        """Let the stiffness grow from 0 again."""
        self._ramped = 0

    def braking(self) -> Asked:
        """Resist motion, without holding a place."""
        return 0.0, 0.0, 0.0, self.damping, 0.0

    def set_point(self, value: float, position: float, velocity: float) -> Asked:
        """What brings the motor to a set-point.

        Args:
            value: Set-point [unit of the commanded element].
            position: Where the motor is [rad]; the pull of the stiffness from there is kept below `max_effort`.
            velocity: How fast it turns [rad/s].
        """
        most = self._most
        if self._mode == "effort":
            return 0.0, 0.0, 0.0, 0.0, min(max(value * self.scale, -most), most)
        if self._mode == "velocity":
            speed = value / self.scale
            if self._is_limited:
                reach = most / self.damping
                speed = min(max(speed, velocity - reach), velocity + reach)
            return 0.0, speed, 0.0, self.damping, 0.0
        self._ramped = min(self._ramped + 1, self._ramp_cycles)
        stiffness = self._stiffness * self._ramped / self._ramp_cycles
        angle = (value - self.zero) / self.scale
        if self._is_limited:
            reach = most / stiffness
            angle = min(max(angle, position - reach), position + reach)
        return angle, 0.0, stiffness, self.damping, 0.0
