"""Position and velocity ranges for velocity and effort commands: a velocity brakes in time, an effort fades out."""

import numpy as np
from typing_extensions import override

from hal.safety.feedback import MeasuredRange
from hal.safety.limit import CycleState, Limit, changed

RESPONSE = 0.02
"""A drive may lag behind its command by this time [s]."""
CALM = 2.0
"""The last part of the way takes this multiple of the age of the measurement. With 1 the drive would oscillate about
the end, as any loop whose dead time equals its time constant."""
FADE_BAND = 0.1
"""An effort towards an end of the range fades out within this part of the range."""


class EndsOfVelocity(Limit):
    """Limit of a velocity command, which brakes so that the position comes to rest inside its range.

    A velocity v that starts to brake `ahead` too late continues for `v * ahead + v^2 / (2 deceleration)`. Solved for v,
    this never needs more than `deceleration`. Beyond an end only the way back is allowed. Where the position is unknown
    the command is 0.
    """

    name = "range"
    needs = "position"

    def __init__(self, position: MeasuredRange, deceleration: np.ndarray | None, ahead: float) -> None:
        """Prepare.

        Args:
            position: Position of the commanded elements.
            deceleration: Deceleration of the command [unit of the command/s], shape (k,); None for no limit.
            ahead: Largest age [s] of a position at the time at which the drive has followed a command.
        """
        self.feedback = self._position = position
        self._deceleration = deceleration
        self._ahead = CALM * ahead

    @override
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        source = self._position
        position = source.read(state.measured)
        up, down = self._fastest(source.high - position), self._fastest(position - source.low)
        own = desired[source.commanded]
        bounded = np.where(np.isfinite(position), np.minimum(np.maximum(own, -down), up), 0.0)
        if (bounded == own).all():
            return desired
        limited = desired.copy()
        limited[source.commanded] = bounded
        return limited

    def _fastest(self, left: np.ndarray) -> np.ndarray:
        left = np.maximum(left, 0.0)
        if self._deceleration is None:
            return left / self._ahead
        return self._deceleration * (np.sqrt(self._ahead**2 + 2.0 / self._deceleration * left) - self._ahead)


class EndsOfEffort(Limit):
    """Limit of an effort command, which fades out towards the end of the range of a position or velocity.

    In the other direction the effort is not limited. Where position or velocity is unknown the command is 0. Beyond the
    range `Trips` stops the robot.
    """

    def __init__(self, name: str, source: MeasuredRange) -> None:
        """Prepare; `name` is reported in `Applied.limited_by`, `source` has positions or velocities."""
        self.name = name
        self.needs = "position" if name == "range" else name
        self.feedback = self._source = source
        span = source.high - source.low
        self._band = FADE_BAND * np.where(np.isfinite(span), span, 1.0)  # an open range has no span

    @override
    def limit(self, desired: np.ndarray, state: CycleState) -> np.ndarray:
        source = self._source
        value = source.read(state.measured)
        own = desired[source.commanded]
        left = np.where(own > 0, source.high - value, value - source.low)
        share = np.minimum(np.maximum(left / self._band, 0.0), 1.0)
        limited = desired.copy()
        limited[source.commanded] = np.where(np.isfinite(value), own * share, 0.0)
        return changed(limited, desired)
