"""Rotor that turns a torque or a speed into a position: the world needs one from drives without a position
set-point.
"""

import math
from dataclasses import dataclass


@dataclass(slots=True)
class Rotor:
    """Inertia and viscous friction of motor and gear, seen at the output; the world's servo follows its position.

    Attributes:
        inertia: Inertia [kg m2], or [kg] for a wire.
        friction: Friction [N m s/rad], or [N s/m] for a wire.
        position: Position [rad or m].
        velocity: Velocity [rad/s or m/s].
    """

    inertia: float
    friction: float
    position: float = 0.0
    velocity: float = 0.0

    def rest(self, position: float) -> None:
        """Stand still at `position` [rad or m]."""
        self.position, self.velocity = position, 0.0

    def push(self, effort: float, duration: float) -> float:
        """Return the position [rad or m] after `effort` [N m or N], load already subtracted, has acted for `duration`
        [s].

        This is the exact solution of inertia * dv/dt = effort - friction * v, stable for every duration.
        """
        rate = self.friction / self.inertia
        if rate * duration < 1e-9:
            final = self.velocity + effort / self.inertia * duration
            self.position += 0.5 * (self.velocity + final) * duration
        else:
            end = effort / self.friction
            decay = math.exp(-rate * duration)
            final = end + (self.velocity - end) * decay
            self.position += end * duration + (self.velocity - end) * (1.0 - decay) / rate
        self.velocity = final
        return self.position

    def run(self, velocity: float, duration: float) -> float:
        """Return the position [rad or m] after turning at `velocity` [rad/s or m/s] for `duration` [s]."""
        self.velocity = velocity
        self.position += velocity * duration
        return self.position
