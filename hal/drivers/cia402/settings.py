"""Settings of a servo drive, with the quantities, PDOs and units that follow from them."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.calibration.line import Linear, rotary, spool
from hal.commissioning.pdo_map import Pdo, PdoMap, lay_out
from hal.config import Finite, Positive, Section
from hal.drivers.canopen.node import NodeSettings
from hal.protocols import cia301, cia402
from hal.protocols.cia301 import MappedObject
from hal.protocols.cia402 import OperationMode, VelocityUnit

MODES = {
    "profile_position": OperationMode.PROFILE_POSITION,
    "ip": OperationMode.INTERPOLATED_POSITION,
    "csp": OperationMode.CYCLIC_SYNCHRONOUS_POSITION,
    "csv": OperationMode.CYCLIC_SYNCHRONOUS_VELOCITY,
    "cst": OperationMode.CYCLIC_SYNCHRONOUS_TORQUE,
}
"""Modes by their names in a robot file."""
COMMANDED = {"profile_position": "position", "ip": "position", "csp": "position", "csv": "velocity", "cst": "effort"}
TARGETS = {
    "position": cia402.TARGET_POSITION,
    "velocity": cia402.TARGET_VELOCITY,
    "effort": cia402.TARGET_TORQUE,
}
"""Commanded quantity -> object of its set-point."""
OBJECTS = {
    "position": cia402.POSITION,
    "effort": cia402.TORQUE,
    "velocity": cia402.VELOCITY,
    "following_error": cia402.FOLLOWING_ERROR,
}
"""Measured quantity -> its object, in the order of the mapping."""


class TemperatureSettings(Section):
    """The object of a drive's temperature; the standard defines none."""

    object: str
    """Index and sub-index, as in `2200h:1`."""
    type: str = "int16"
    scale: Finite = 0.1
    """Degrees Celsius per count."""
    zero: Finite = 0.0
    """Degrees Celsius at zero counts; -273.15 for a drive that counts kelvins."""
    every: Annotated[int, Field(ge=1, le=240)] = 20
    """The drive sends it with every n-th SYNC."""
    event_time: Positive | None = None
    """Period [s] in which the drive sends it, in place of `every`."""

    @model_validator(mode="after")
    def _is_object(self) -> "TemperatureSettings":
        cia301.mapped(self.object, self.type)
        if not self.scale:
            raise ValueError("a scale of 0 makes every temperature the same.")
        return self

    @property
    def mapped(self) -> MappedObject:
        """Object of the temperature."""
        return cia301.mapped(self.object, self.type)


class ProfileSettings(Section):
    """The motion profile of profile position mode; an absent value stays as it is in the drive."""

    velocity: Positive | None = None
    """Velocity [rad/s or m/s], object 6081h."""
    acceleration: Positive | None = None
    """Acceleration [rad/s2 or m/s2], object 6083h."""
    deceleration: Positive | None = None
    """Deceleration [rad/s2 or m/s2], object 6084h."""


class HomingSettings(Section):
    """The drive's own search for its zero."""

    method: Annotated[int, Field(ge=-128, le=127)]
    """Object 6098h: 17 and 18 negative and positive limit switch, 33 and 34 next index pulse, 37 present position."""
    speed: Positive
    """Speed of the search for the switch [rad/s or m/s], object 6099h:1."""
    slow_speed: Positive
    """Speed of the search for the edge or the index [rad/s or m/s], object 6099h:2."""
    acceleration: Positive | None = None
    """Acceleration [rad/s2 or m/s2], object 609Ah."""
    offset: Finite = 0.0
    """Distance from the home position to the zero position, in the drive's direction [rad or m], object 607Ch; `zero`
    is the value at the zero position."""
    timeout: Positive = 60.0
    """Homing fails after this time [s]."""


class DriveSettings(NodeSettings):
    """Settings of a drive."""

    mode: Literal["profile_position", "ip", "csp", "csv", "cst"] = "csp"
    """Profile position, interpolated position, or cyclic synchronous position, velocity or torque."""
    counts_per_turn: Positive
    """Encoder counts per motor turn."""
    gear: Positive = 1.0
    """Motor turns per turn of the output."""
    spool_radius: Positive | None = None
    """Radius of the spool or pulley [m]; without one the drive turns a joint."""
    direction: Literal[1, -1] = 1
    """1 if counts grow with the value, else -1."""
    zero: Finite = 0.0
    """Value at zero counts [m or rad]."""
    velocity_unit: Literal["counts/s", "rps", "rpm", "0.1 rpm", "mrpm"] | None = None
    """Unit of the drive's velocities, in turns of the motor; absent: that of object 60A9h, else counts/s."""
    rated_torque: Positive | None = None
    """Motor rated torque [N m]; absent: object 6076h, by the standard (not every drive) in mN m."""
    max_torque: Annotated[int, Field(ge=0, le=10_000)] | None = None
    """Value of object 6072h [thousandths of the rated torque]; absent: not changed."""
    max_velocity: Positive | None = None
    """Value of objects 607Fh and 6080h [rad/s or m/s]; absent: not changed."""
    following_error: Positive | None = None
    """The drive faults beyond this following error [rad or m], object 6065h; absent: not changed."""
    profile: ProfileSettings = ProfileSettings()
    """Motion profile of profile position mode."""
    temperature: TemperatureSettings | None = None
    """Object of the temperature; absent: the drive has none."""
    homing: HomingSettings | None = None
    """Homing of the drive; absent: none."""
    damping: Positive | None = None
    """Damping of `damp` in the mode cst [N m s/rad or N s/m]."""
    watch_time: Annotated[float, Field(ge=0.1, le=5.0)] = 0.15
    """The drive stops by itself after this time [s] without the HAL's heartbeat (object 1016h)."""
    allow_no_watchdog: bool = False
    """Accept a drive that cannot monitor the HAL's heartbeat and goes on moving when the HAL is gone."""

    @model_validator(mode="after")
    def _fits_the_mode(self) -> "DriveSettings":
        if self.damping is not None and self.mode != "cst":
            raise ValueError(f"damping needs the mode cst, not {self.mode}.")
        if self.profile != ProfileSettings() and self.mode != "profile_position":
            raise ValueError(f"profile needs the mode profile_position, not {self.mode}.")
        return self

    @property
    def commanded(self) -> str:
        """Commanded quantity."""
        return COMMANDED[self.mode]

    @property
    def target(self) -> MappedObject:
        """Object of the set-point."""
        return cia402.INTERPOLATION_DATA if self.mode == "ip" else TARGETS[self.commanded]

    @property
    def quantities(self) -> tuple[str, ...]:
        """Measured quantities, the commanded quantity first."""
        rest = (*OBJECTS, *(("temperature",) if self.temperature else ()))
        return (self.commanded, *(quantity for quantity in rest if quantity != self.commanded))

    def pdos(self, quantities: tuple[str, ...]) -> PdoMap:
        """Return the PDOs of these quantities and of the objects that the driver needs."""
        needed = set(quantities)
        if self.commanded == "position":
            needed.add("position")  # to start from
        if self.damping is not None:
            needed.add("velocity")
        cyclic = (cia402.STATUSWORD, *(item for quantity, item in OBJECTS.items() if quantity in needed))
        sends = lay_out(cyclic)
        slow = [self.temperature.mapped] if self.temperature and "temperature" in quantities else []
        if self.homing:
            slow.append(cia402.MODE_DISPLAY)
        if slow:
            sends += self._slow(slow, len(sends) + 1)
        receives = [cia402.CONTROLWORD, self.target]
        if self.homing:
            receives.insert(1, cia402.MODE_OF_OPERATION)
        return PdoMap(lay_out(receives), sends)

    def _slow(self, objects: list[MappedObject], first: int) -> tuple[Pdo, ...]:
        timing = self.temperature or TemperatureSettings(object="2200h")
        if timing.event_time is None:
            return lay_out(objects, first, timing.every)
        return lay_out(objects, first, cia301.EVENT_DRIVEN[0], timing.event_time)


LARGEST_COUNT = 2**31 - 1
LARGEST_TORQUE = 2**15 - 1


@dataclass(frozen=True, slots=True)
class DriveUnits:
    """The units of a drive's numbers.

    Attributes:
        position: Counts -> [rad or m].
        velocity: One velocity unit [rad/s or m/s]; negative if counts grow the other way.
        effort: A thousandth of the rated torque [N m at the joint, or N at the wire], in the direction of growing
            position: motor torque times gear (over the radius), without friction of the gear. A taut wire held by its
            motor has a negative effort, because it pulls towards greater length. NaN if the rated torque is unknown.
        motor_turn: One turn of the motor [rad or m].
    """

    position: Linear
    velocity: float
    effort: float
    motor_turn: float

    def counts(self, value: float) -> int:
        """Return the nearest target position [counts] of a position [rad or m]."""
        return _clip(self.position.to_counts(value), LARGEST_COUNT)

    def speed(self, value: float) -> int:
        """Return the nearest target velocity [velocity units] of a velocity [rad/s or m/s]."""
        return _clip(value / self.velocity, LARGEST_COUNT)

    def torque(self, value: float) -> int:
        """Return the nearest target torque [thousandths of the rated torque] of an effort [N m or N]."""
        return _clip(value / self.effort, LARGEST_TORQUE)

    def size(self, value: float, per_unit: float) -> int:
        """Return a bound for an unsigned object: at least 1, at most 2^31 - 1."""
        return min(max(round(abs(value / per_unit)), 1), LARGEST_COUNT)


def drive_units(settings: DriveSettings, unit: VelocityUnit, rated_torque: float) -> DriveUnits:
    """Return the units of one drive.

    Args:
        settings: Its settings.
        unit: Unit of its velocities.
        rated_torque: Rated torque of its motor [N m]; NaN if unknown.
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
