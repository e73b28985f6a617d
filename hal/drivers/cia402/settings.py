"""What a robot file says of a servo drive, and what follows from it: quantities, PDOs and units."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.calibration.line import Linear, rotary, spool
from hal.commissioning.pdo_map import Pdo, PdoMap, lay_out
from hal.config import Finite, Positive, Section
from hal.drivers.canopen.node import NodeSettings
from hal.protocols import cia301, cia402
from hal.protocols.cia301 import Mapped
from hal.protocols.cia402 import Mode, VelocityUnit

MODES = {
    "profile_position": Mode.PROFILE_POSITION,
    "csp": Mode.CYCLIC_SYNCHRONOUS_POSITION,
    "csv": Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    "cst": Mode.CYCLIC_SYNCHRONOUS_TORQUE,
}
"""Modes as a robot file names them."""
COMMANDED = {"profile_position": "position", "csp": "position", "csv": "velocity", "cst": "effort"}
TARGETS = {
    "position": cia402.TARGET_POSITION,
    "velocity": cia402.TARGET_VELOCITY,
    "effort": cia402.TARGET_TORQUE,
}
"""Commanded quantity -> the object that takes it."""
OBJECTS = {
    "position": cia402.POSITION,
    "effort": cia402.TORQUE,
    "velocity": cia402.VELOCITY,
    "following_error": cia402.FOLLOWING_ERROR,
}
"""Measured quantity -> the object that has it, in the order in which they are mapped."""


class TemperatureSettings(Section):
    """Where a drive has a temperature; the standard has no object for it."""

    object: str
    """As in `2200h:1`."""
    type: str = "int16"
    scale: Finite = 0.1
    """Degrees Celsius per count."""
    zero: Finite = 0.0
    """Degrees Celsius at zero counts; -273.15 for a drive that counts kelvins."""
    every: Annotated[int, Field(ge=1, le=240)] = 20
    """Sent with every n-th SYNC."""
    event_time: Positive | None = None
    """Given: sent every so many seconds, whatever the SYNC."""

    @model_validator(mode="after")
    def _is_object(self) -> "TemperatureSettings":
        cia301.mapped(self.object, self.type)
        if not self.scale:
            raise ValueError("a scale of 0 makes every temperature the same.")
        return self

    @property
    def mapped(self) -> Mapped:
        """The object."""
        return cia301.mapped(self.object, self.type)


class ProfileSettings(Section):
    """How a drive moves in profile position mode; what is absent is left as it is in the drive."""

    velocity: Positive | None = None
    """[rad/s or m/s], object 6081h."""
    acceleration: Positive | None = None
    """[rad/s2 or m/s2], object 6083h."""
    deceleration: Positive | None = None
    """[rad/s2 or m/s2], object 6084h."""


class HomingSettings(Section):
    """How a drive finds its zero by itself."""

    method: Annotated[int, Field(ge=-128, le=127)]
    """Object 6098h: 17 and 18 negative and positive limit switch, 33 and 34 next index pulse, 37 where it is."""
    speed: Positive
    """Of the search for the switch [rad/s or m/s], object 6099h:1."""
    slow_speed: Positive
    """Of the search for the edge or the index [rad/s or m/s], object 6099h:2."""
    acceleration: Positive | None = None
    """[rad/s2 or m/s2], object 609Ah."""
    offset: Finite = 0.0
    """From the home position to the zero position, with the drive's direction [rad or m], object 607Ch; `zero` is the
    value at the zero position."""
    timeout: Positive = 60.0
    """After so long [s] it is given up."""


class DriveSettings(NodeSettings):
    """Settings of a drive."""

    mode: Literal["profile_position", "csp", "csv", "cst"] = "csp"
    """Profile position, or cyclic synchronous position, velocity or torque."""
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
    """Of the drive's velocities, turns being the motor's; absent: what object 60A9h says, else counts/s."""
    rated_torque: Positive | None = None
    """Motor rated torque [N m]; absent: object 6076h, by the standard (not every drive) in mN m."""
    max_torque: Annotated[int, Field(ge=0, le=10_000)] | None = None
    """Written to object 6072h [thousandths of the rated torque]; absent: left as it is."""
    max_velocity: Positive | None = None
    """Written to objects 607Fh and 6080h [rad/s or m/s]; absent: left as they are."""
    following_error: Positive | None = None
    """Beyond it the drive faults [rad or m], object 6065h; absent: left as it is."""
    profile: ProfileSettings = ProfileSettings()
    """For profile position mode."""
    temperature: TemperatureSettings | None = None
    """Where the drive has a temperature."""
    homing: HomingSettings | None = None
    """How it finds its zero; absent: it need not or cannot."""
    damping: Positive | None = None
    """For `damp` in the mode cst [N m s/rad or N s/m]."""
    watch_time: Annotated[float, Field(ge=0.1, le=5.0)] = 0.15
    """How long [s] the drive waits for the HAL's heartbeat before it stops by itself (object 1016h)."""
    allow_no_watchdog: bool = False
    """Use a drive that cannot wait for the HAL's heartbeat, and goes on moving when the HAL is gone."""

    @model_validator(mode="after")
    def _fits_the_mode(self) -> "DriveSettings":
        if self.damping is not None and self.mode != "cst":
            raise ValueError(f"damping needs the mode cst, not {self.mode}.")
        if self.profile != ProfileSettings() and self.mode != "profile_position":
            raise ValueError(f"profile needs the mode profile_position, not {self.mode}.")
        return self

    @property
    def commanded(self) -> str:
        """The quantity that is commanded."""
        return COMMANDED[self.mode]

    @property
    def quantities(self) -> tuple[str, ...]:
        """What the drive can measure, the commanded quantity first."""
        rest = (*OBJECTS, *(("temperature",) if self.temperature else ()))
        return (self.commanded, *(quantity for quantity in rest if quantity != self.commanded))

    def pdos(self, quantities: tuple[str, ...]) -> PdoMap:
        """The PDOs that carry some quantities, and what the driver needs besides."""
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
        receives = [cia402.CONTROLWORD, TARGETS[self.commanded]]
        if self.homing:
            receives.insert(1, cia402.MODE_OF_OPERATION)
        return PdoMap(lay_out(receives), sends)

    def _slow(self, objects: list[Mapped], first: int) -> tuple[Pdo, ...]:
        timing = self.temperature or TemperatureSettings(object="2200h")
        if timing.event_time is None:
            return lay_out(objects, first, timing.every)
        return lay_out(objects, first, cia301.EVENT_DRIVEN[0], timing.event_time)


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
