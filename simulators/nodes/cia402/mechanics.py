"""Motor, encoder, winding and set-point generator of a simulated drive, on the values of its object dictionary."""

import math

from simulators.nodes.canopen.objects import Key, Value
from simulators.nodes.canopen.spec import DriveConstants
from simulators.nodes.cia402.motion import (
    CYCLIC_POSITION,
    CYCLIC_TORQUE,
    CYCLIC_VELOCITY,
    HOMING,
    INTERPOLATED_POSITION,
    PROFILE_POSITION,
    Homing,
    Profile,
    SetPoints,
)
from simulators.nodes.plant import Plant
from simulators.nodes.rotor import Rotor

_INT16, _INT32 = 2**15, 2**31
_AMBIENT = 25.0
"""The surroundings have this temperature [degC]."""
_START_HOMING = INTERPOLATE = 1 << 4
_NEGATIVE_LIMIT, _POSITIVE_LIMIT = 1, 2
"""These are bits of the digital inputs, object 60FDh."""
_REVOLUTION, _MINUTE = 0xB4, 0x47
"""These codes are parts of a velocity unit (CiA 303-2)."""


class DriveMechanics:
    """Measured state and demand of the drive; all positions in encoder counts.

    The encoder starts at the constants' zero; homing moves its origin until the next power-on.
    """

    def __init__(self, constants: DriveConstants, element: str, plant: Plant, values: dict[Key, Value]) -> None:
        self._constants = constants
        self._element = element
        self._plant = plant
        self._values = values
        ends = sorted((end - constants.zero) * constants.counts_per_unit for end in constants.switches)
        self.homing = Homing((ends[0], ends[1]), constants.counts_per_turn)
        self.set_points = SetPoints()
        self._profile = Profile()
        self._rotor = Rotor(constants.inertia, constants.friction)
        self._warmth = 0.0
        """How much warmer than its surroundings the winding is [K]."""
        self.restart()

    def restart(self) -> None:
        """Be as after power-on; the winding stays as warm as it is."""
        self._origin = 0.0
        self._raw = 0.0
        self._demand = 0.0
        self.velocity = 0.0
        """Measured velocity [counts/s]."""
        self._before: tuple[float, float] | None = None
        self._moved_at = 0.0
        self._measured_at: float | None = None
        self._push = 0
        self.is_limited = False
        self.is_reached = False
        self.homing.stop()
        self.homing.is_attained = self.homing.is_wrong = False
        self.set_points.clear()

    @property
    def target(self) -> float:
        """Target of the world's servo [m or rad]."""
        return self._constants.zero + (self._demand + self._origin) / self._constants.counts_per_unit

    def measure(self, now: float, is_free: bool) -> None:
        """Bring what the drive measures up to date.

        Args:
            now: [s].
            is_free: Without power: the demand is where the drive is, and there is no torque but what the brake takes.
        """
        values, constants = self._values, self._constants
        self._raw = _finite((self._plant.read(self._element) - constants.zero) * constants.counts_per_unit)
        position = _clip(self._raw - self._origin, _INT32)
        self._differentiate(self._raw - self._origin)
        if is_free:
            self._demand = position
            self._push = 0
        torque = self._push if self._values[0x6060, 0] == CYCLIC_TORQUE and not is_free else self._carried()
        self._warm(now, 0 if is_free else torque)
        values[0x6064, 0] = position
        values[0x606C, 0] = _clip(self.velocity / self._per_unit(), _INT32)
        values[0x6077, 0] = torque
        values[0x6062, 0] = _clip(self._demand, _INT32)
        values[0x60F4, 0] = _clip(self._demand - position, _INT32)
        values[0x60FD, 0] = self._switches()
        values[0x2200, 1] = _clip(10 * (_AMBIENT + self._warmth), _INT16)
        self.is_limited = (self.is_limited and not is_free) or abs(torque) >= int(values[0x6072, 0])

    def start(self, now: float) -> None:
        """Start at rest from the present position, after enabling or a change of mode."""
        position = float(self._values[0x6064, 0])
        self._demand = position
        self._moved_at = now
        self._push = 0
        self._profile.rest(position)
        self._rotor.rest(self.target)
        self.set_points.clear()
        self.homing.stop()
        self.is_reached = False

    def command(self, mode: int, word: int, before: int) -> None:
        """Take a control word that leaves the drive enabled."""
        if mode == PROFILE_POSITION:
            self.set_points.take(word, before, int(self._values[0x607A, 0]), round(self._demand))
        elif mode == HOMING:
            if word & _START_HOMING and not before & _START_HOMING:
                self.homing.start(int(self._values[0x6098, 0]), self._raw)
            elif not word & _START_HOMING:
                self.homing.stop()

    def move(self, now: float, mode: int, word: int) -> None:
        """Move the demand on to `now` [s]."""
        duration, self._moved_at = now - self._moved_at, now
        self.is_limited = False
        if mode == CYCLIC_POSITION:
            self._demand = self._limited(int(self._values[0x607A, 0]))
        elif mode == INTERPOLATED_POSITION:
            if word & INTERPOLATE:  # otherwise the data record waits
                self._demand = self._limited(int(self._values[0x60C1, 1]))
        elif mode == PROFILE_POSITION:
            self._go(duration, word)
        elif mode == HOMING:
            self._search(duration)
        elif mode in (CYCLIC_VELOCITY, CYCLIC_TORQUE) and duration > 0:
            self._turn(mode, duration)

    def brake(self) -> None:
        """Set the demand to the position where the drive stops at the quick stop deceleration (6085h)."""
        fall = int(self._values[0x6085, 0]) * self._per_unit()
        way = self.velocity * abs(self.velocity) / (2.0 * fall)
        self._push = 0
        self.homing.stop()
        self.set_points.clear()
        self._demand = self._limited(_clip(int(self._values[0x6064, 0]) + way, _INT32))

    def _go(self, duration: float, word: int) -> None:
        """Advance profile position mode."""
        points, values, unit = self.set_points, self._values, self._per_unit()
        if points.target is None:
            return
        speed = 0.0 if points.is_halted(word) else min(int(values[0x6081, 0]) * unit, self._fastest())
        rise, fall = (int(values[index, 0]) * unit for index in (0x6083, 0x6084))
        target = self._limited(points.target)
        self._demand = self._profile.step(target, max(speed, 1e-9), rise, fall, duration)
        self.is_reached = self._profile.position == target
        if self.is_reached:
            points.reached(word)

    def _search(self, duration: float) -> None:
        """Advance homing mode."""
        if not self.homing.is_busy:
            if self.homing.is_attained:
                self._take_home()
            return
        unit = self._per_unit()
        fast, slow = (int(self._values[0x6099, sub]) * unit for sub in (1, 2))
        demand = self.homing.step(self._raw, self._demand + self._origin, fast, slow, duration)
        self._demand = demand - self._origin
        if self.homing.is_attained:
            self._take_home()

    def _take_home(self) -> None:
        """Count from the zero position, which is the home position plus the home offset (607Ch)."""
        origin = self.homing.home + int(self._values[0x607C, 0])
        if origin != self._origin:
            self._demand += self._origin - origin
            self._origin, self._before = origin, None

    def _turn(self, mode: int, duration: float) -> None:
        """Advance cyclic synchronous velocity or torque: the rotor turns, and the demand follows it."""
        constants, values, rotor = self._constants, self._values, self._rotor
        scale = constants.counts_per_unit
        fastest = self._fastest() / abs(scale)
        if mode == CYCLIC_VELOCITY:
            velocity = int(values[0x60FF, 0]) * self._per_unit() / scale
            self.is_limited = abs(velocity) > fastest
            rotor.run(min(max(velocity, -fastest), fastest), duration)
        else:
            bound = int(values[0x6072, 0])
            demand = int(values[0x6071, 0])
            self._push = min(max(demand, -bound), bound)
            self.is_limited = self._push != demand
            rotor.push(self._at_output(self._push - self._carried()), duration)
            if abs(rotor.velocity) > fastest:
                rotor.velocity, self.is_limited = math.copysign(fastest, rotor.velocity), True
        self._demand = (rotor.position - constants.zero) * scale - self._origin
        low, high = (int(values[0x607D, sub]) for sub in (1, 2))
        if not low <= self._demand <= high:
            self._demand = min(max(self._demand, low), high)
            rotor.rest(self.target)
            self.is_limited = True

    def _limited(self, target: int) -> int:
        """Limit a set-point to 607Dh, and not further into a load that already takes the largest torque (6072h)."""
        values = self._values
        target = min(max(target, int(values[0x607D, 1])), int(values[0x607D, 2]))
        torque, position = int(values[0x6077, 0]), int(values[0x6064, 0])
        if abs(torque) >= int(values[0x6072, 0]) and (target - position) * torque > 0:
            return position
        return target

    def _fastest(self) -> float:
        """Return the lower of 607Fh and 6080h [counts/s]."""
        motor = int(self._values[0x6080, 0]) * self._constants.counts_per_turn / 60.0
        return min(int(self._values[0x607F, 0]) * self._per_unit(), motor)

    def _per_unit(self) -> float:
        """Return counts per second in one unit of velocity, by object 60A9h."""
        code = int(self._values[0x60A9, 0])
        exponent = (code >> 24 ^ 0x80) - 0x80
        counts = float(self._constants.counts_per_turn) if code >> 16 & 0xFF == _REVOLUTION else 1.0
        return counts * 10.0**exponent / (60.0 if code >> 8 & 0xFF == _MINUTE else 1.0)

    def _differentiate(self, position: float) -> None:
        """Update the velocity, which a drive measures more finely than in counts per period."""
        time = self._plant.time
        if self._before is None:
            self._before = (time, position)
        elif time > self._before[0]:
            self.velocity = (position - self._before[1]) / (time - self._before[0])
            self._before = (time, position)

    def _carried(self) -> int:
        """Return the motor torque that holds the load [thousandths of the rated one]; a taut wire pulls towards
        growing length.
        """
        constants = self._constants
        if constants.load is None:
            return 0
        load = self._plant.read(constants.load)
        arm = -constants.spool_radius if constants.spool_radius else 1.0
        share = constants.direction * load * arm / constants.gear / constants.rated_torque
        return _clip(share * 1e3, _INT16)

    def _at_output(self, thousandths: int) -> float:
        """Return the effort at the output [N m or N] towards a growing position."""
        constants = self._constants
        torque = thousandths * 1e-3 * constants.rated_torque * constants.gear * constants.direction
        return torque / (constants.spool_radius or 1.0)

    def _warm(self, now: float, torque: int) -> None:
        """Advance the temperature of the winding, which heats with the square of the torque."""
        if self._measured_at is not None:
            end = self._constants.heating * (torque * 1e-3) ** 2
            part = -math.expm1(-(now - self._measured_at) / self._constants.thermal_time)
            self._warmth += (end - self._warmth) * part
        self._measured_at = now

    def _switches(self) -> int:
        """Return the limit switches towards lower and higher counts."""
        low, high = self.homing.switches
        return _NEGATIVE_LIMIT * (self._raw <= low) | _POSITIVE_LIMIT * (self._raw >= high)


def _finite(value: float) -> float:
    return 0.0 if math.isnan(value) else value


def _clip(value: float, bound: int) -> int:
    """Return the nearest integer that fits; 0 for NaN."""
    if math.isnan(value):
        return 0
    return round(min(max(value, -bound), bound - 1))
