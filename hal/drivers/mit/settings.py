"""What a robot file says of a drive in MIT mode."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.config import Finite, Positive, Section
from hal.drivers.can_device import DeviceSettings
from hal.errors import ConfigError
from hal.protocols import mit_motors
from hal.protocols.mit import Layout, Ranges

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class RangesSettings(Section):
    """What is known better of a motor than by the table, or of one that is not in it."""

    position: Positive | None = None
    """Largest position of its frames [rad]."""
    velocity: Positive | None = None
    """[rad/s]"""
    effort: Positive | None = None
    """[N m]"""
    stiffness: Positive | None = None
    """[N m/rad]; 500 where neither this nor the table says otherwise."""
    damping: Positive | None = None
    """[N m s/rad]; 5 likewise."""
    layout: Layout | None = None
    """Who packed its answers: `t_motor`, `damiao` or `mini_cheetah`."""


class MitSettings(DeviceSettings):
    """Settings of a drive. Stiffness, damping and effort are those of the joint or wire, behind gear and spool."""

    motor: str
    """As in the table of docs/devices.md, or any name if `ranges` is complete."""
    ranges: RangesSettings = RangesSettings()
    """Takes precedence over the table, value by value."""
    master_id: Annotated[int, Field(ge=0, le=0x7FF)] | None = None
    """Identifier of its answers; absent: 0 for T-Motor and mini-cheetah, node + 16 for Damiao."""
    mode: Literal["position", "velocity", "effort"] = "position"
    """What it is commanded by: stiffness and damping, damping alone, or neither."""
    stiffness: NotNegative = 0.0
    """kp [N m/rad, or N/m with a spool]; needed with `mode: position`."""
    damping: Positive
    """kd [N m s/rad, or N s/m]; also what a quick stop brakes with."""
    ramp: NotNegative = 0.5
    """Time [s] in which the stiffness grows from 0 after being enabled."""
    gear: Positive = 1.0
    """Turns of the motor's own output per turn of the joint or spool; its own gear is in its frames already."""
    spool_radius: Positive | None = None
    """Radius of the spool [m]; without one the drive turns a joint."""
    direction: Literal[1, -1] = 1
    """1 if the motor's angle grows with the value, else -1."""
    zero: Finite = 0.0
    """Value [rad or m] where the motor's angle is zero."""
    max_effort: Positive | None = None
    """Largest effort [N m or N] that is asked for; absent: what the frame can carry."""
    watch_time: Annotated[float, Field(ge=0.02, le=5.0)] = 0.15
    """How long [s] a Damiao drive waits for a frame before it powers off by itself."""
    allow_no_watchdog: bool = False
    """Accept a drive that goes on with its last frame for ever when the HAL or the cable dies."""

    @model_validator(mode="after")
    def _fits(self) -> "MitSettings":
        try:
            layout, ranges = self.actuator
        except ConfigError as error:
            raise ValueError(str(error)) from None
        if self.mode == "position" and not self.stiffness:
            raise ValueError("with `mode: position` a `stiffness` above 0 is needed.")
        if layout is Layout.MINI_CHEETAH and self.mode == "effort":
            raise ValueError("answers in the layout `mini_cheetah` carry no torque, so that `mode: effort` cannot be.")
        if layout is not Layout.DAMIAO and not self.allow_no_watchdog:
            raise ValueError(
                f"motor '{self.motor}' has no watchdog that can be set or read over CAN: when the HAL or the cable "
                "dies, it goes on with its last frame. If something else takes its power away then, say "
                "`allow_no_watchdog: true`."
            )
        scale = self.scale**2
        for name, value, most in (
            ("stiffness", self.stiffness, ranges.stiffness),
            ("damping", self.damping, ranges.damping),
        ):
            if value * scale > most:
                raise ValueError(f"{name} {value:g} is more than the motor's frames carry, {most / scale:g} at most.")
        return self

    @property
    def scale(self) -> float:
        """Value [rad or m] per radian of the motor."""
        return self.direction / self.gear * (self.spool_radius or 1.0)

    @property
    def actuator(self) -> tuple[Layout, Ranges]:
        """Layout and ranges of the motor, of the table with `ranges` over it.

        Raises:
            ConfigError: The motor is not in the table, and `ranges` is not complete.
        """
        own = self.ranges
        if own.position and own.velocity and own.effort and own.layout:
            return own.layout, Ranges(
                own.position, own.velocity, own.effort, own.stiffness or 500.0, own.damping or 5.0
            )
        known = mit_motors.motor(self.motor)
        table = known.ranges
        return own.layout or known.layout, Ranges(
            own.position or table.position,
            own.velocity or table.velocity,
            own.effort or table.effort,
            own.stiffness or table.stiffness,
            own.damping or table.damping,
        )
