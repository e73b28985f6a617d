"""Demand position [counts] of a simulated drive in each of its modes (CiA 402-2)."""

import math
from dataclasses import dataclass, field

PROFILE_POSITION, HOMING, INTERPOLATED_POSITION = 1, 6, 7
CYCLIC_POSITION, CYCLIC_VELOCITY, CYCLIC_TORQUE = 8, 9, 10

_NEW_SET_POINT, _AT_ONCE, _RELATIVE, _HALT = 1 << 4, 1 << 5, 1 << 6, 1 << 8
"""These are bits of the control word in profile position mode."""


@dataclass(slots=True)
class Profile:
    """A trapezoidal move.

    Attributes:
        position: Position [counts].
        velocity: Velocity [counts/s].
    """

    position: float = 0.0
    velocity: float = 0.0

    def rest(self, position: float) -> None:
        """Stand still at `position` [counts]."""
        self.position, self.velocity = position, 0.0

    def step(self, target: float, speed: float, rise: float, fall: float, duration: float) -> float:
        """Return the position [counts] after `duration` [s] on the distance to `target` [counts].

        Args:
            target: Target [counts].
            speed: Highest speed [counts/s].
            rise: Acceleration [counts/s2].
            fall: Deceleration [counts/s2].
            duration: Duration [s].
        """
        distance = target - self.position
        stoppable = fall * (math.sqrt(duration**2 + 2.0 * abs(distance) / fall) - duration)  # after this step too
        allowed = min(speed, stoppable)
        target_velocity = math.copysign(allowed, distance)
        is_braking = abs(target_velocity) < abs(self.velocity) or target_velocity * self.velocity < 0.0
        change = (fall if is_braking else rise) * duration
        self.velocity += min(max(target_velocity - self.velocity, -change), change)
        if abs(distance) <= max(abs(self.velocity) * duration, 1.0) and abs(self.velocity) <= 2.0 * fall * duration:
            self.rest(target)
        else:
            self.position += self.velocity * duration
        return self.position


@dataclass(slots=True)
class SetPoints:
    """Handshake of profile position mode: bit 4 of the control word against bit 12 of the status word.

    Attributes:
        target: Target of the drive [counts], or None.
        waiting: A set-point that is taken up when the one before is reached.
        is_acknowledged: Bit 12.
    """

    target: int | None = None
    waiting: list[int] = field(default_factory=list)
    is_acknowledged: bool = False

    def clear(self) -> None:
        """Forget every set-point."""
        self.target, self.is_acknowledged = None, False
        self.waiting.clear()

    def take(self, word: int, before: int, position: int, now: int) -> None:
        """Look at a control word.

        Args:
            word: The control word.
            before: The one before it.
            position: Target position, object 607Ah [counts].
            now: Demand position [counts], which a relative set-point starts from.
        """
        if not word & _NEW_SET_POINT:
            self.is_acknowledged = bool(self.waiting)
        elif not before & _NEW_SET_POINT and not self.waiting:
            self.is_acknowledged = True
            base = (self.target if self.target is not None else now) if word & _RELATIVE else 0
            if word & _AT_ONCE or self.target is None:
                self.target = base + position
            else:
                self.waiting.append(base + position)

    def reached(self, word: int) -> None:
        """Go on to the waiting set-point after the target is reached."""
        if self.waiting:
            self.target = self.waiting.pop(0)
            self.is_acknowledged = bool(word & _NEW_SET_POINT)

    @staticmethod
    def is_halted(word: int) -> bool:
        """Whether the control word says to stand still."""
        return bool(word & _HALT)


NEGATIVE_SWITCH_AND_INDEX, POSITIVE_SWITCH_AND_INDEX = 1, 2
NEGATIVE_SWITCH, POSITIVE_SWITCH = 17, 18
NEGATIVE_INDEX, POSITIVE_INDEX = 33, 34
WHERE_IT_IS = (35, 37)
METHODS = (
    NEGATIVE_SWITCH_AND_INDEX,
    POSITIVE_SWITCH_AND_INDEX,
    NEGATIVE_SWITCH,
    POSITIVE_SWITCH,
    NEGATIVE_INDEX,
    POSITIVE_INDEX,
    *WHERE_IT_IS,
)
"""The drive has these homing methods (CiA 402-2, object 6098h)."""


class Homing:
    """The search for the home position, in raw encoder counts.

    Limit switches are active at and beyond `switches`; the index is at every multiple of `turn`.
    """

    def __init__(self, switches: tuple[float, float], turn: float) -> None:
        """Describe the machine.

        Args:
            switches: Positions of the negative and the positive limit switch [raw counts].
            turn: Counts per motor turn.
        """
        self.switches = switches
        self._turn = turn
        self._phase = ""
        self.is_attained = False
        self.is_wrong = False
        self.home = 0.0
        """Raw counts of the home position, once attained."""

    @property
    def is_busy(self) -> bool:
        """Whether it is searching."""
        return bool(self._phase)

    def stop(self) -> None:
        """Search no further."""
        self._phase = ""

    def start(self, method: int, position: float) -> None:
        """Begin at `position` [raw counts]; a method that the drive does not have is an error."""
        self.is_attained = self.is_wrong = False
        self._method = method
        if method in WHERE_IT_IS:
            self._found(position)
        elif method in (NEGATIVE_INDEX, POSITIVE_INDEX):
            self._to_index(position, method == POSITIVE_INDEX)
        elif method in METHODS:
            self._phase = "switch"
        else:
            self.is_wrong = True
            self._phase = ""

    def step(self, position: float, demand: float, fast: float, slow: float, duration: float) -> float:
        """Return the demand [raw counts] after `duration` [s].

        Args:
            position: Position of the drive [raw counts].
            demand: Demand before [raw counts].
            fast: Speed of the search for the switch [counts/s].
            slow: Speed of the search for its edge and the index [counts/s].
            duration: Duration [s].
        """
        upward = self._method in (POSITIVE_SWITCH, POSITIVE_SWITCH_AND_INDEX)
        sign = 1.0 if upward else -1.0
        edge = self.switches[1] if upward else self.switches[0]
        if self._phase == "switch":
            if sign * (position - edge) >= 0.0:
                self._phase = "edge"
            return demand + sign * fast * duration
        if self._phase == "edge":
            if sign * (position - edge) < 0.0:
                if self._method in (NEGATIVE_SWITCH, POSITIVE_SWITCH):
                    self._found(edge)
                    return demand
                self._to_index(position, not upward)
            return demand - sign * slow * duration
        distance = self._index - position
        if distance * self._to <= 0.0:
            self._found(self._index)
            return demand
        return demand + self._to * slow * duration

    def _to_index(self, position: float, upward: bool) -> None:
        self._phase = "index"
        turns = position / self._turn
        self._index = (math.floor(turns) + 1 if upward else math.ceil(turns) - 1) * self._turn
        self._to = 1.0 if upward else -1.0

    def _found(self, home: float) -> None:
        self.home, self.is_attained, self._phase = home, True, ""
