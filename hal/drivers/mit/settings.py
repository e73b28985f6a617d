"""Settings of a drive in MIT mode."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.config import Finite, Positive, Section
from hal.drivers.can_device import DeviceSettings
from hal.errors import ConfigError
from hal.protocols import mit_motors
from hal.protocols.mit import Layout, Ranges

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class RangesSettings(Section):
    """Ranges that override the table, or those of a motor that is not in it."""

    position: Positive | None = None
    """Largest position of its frames [rad]."""
    velocity: Positive | None = None
    """Largest velocity [rad/s]."""
    effort: Positive | None = None
    """Largest torque [N m]."""
    stiffness: Positive | None = None
    """Largest stiffness [N m/rad]; default 500."""
    damping: Positive | None = None
    """Largest damping [N m s/rad]; default 5."""
    layout: Layout | None = None
    """Layout of its answers: `t_motor`, `damiao` or `mini_cheetah`."""


class MitSettings(DeviceSettings):
    """Settings of a drive. Stiffness, damping and effort are those of the joint or wire, behind gear and spool."""

    motor: str
    """Name in the table of docs/devices.md, or any name if `ranges` is complete."""
    ranges: RangesSettings = RangesSettings()
    """Values that override those of the table."""
    master_id: Annotated[int, Field(ge=0, le=0x7FF)] | None = None
    """Identifier of its answers; absent: 0 for T-Motor and mini-cheetah, node + 16 for Damiao."""
    mode: Literal["position", "velocity", "effort"] = "position"
    """Commanded quantity: position uses stiffness and damping, velocity only damping, effort neither."""
    stiffness: NotNegative = 0.0
    """Stiffness kp [N m/rad, or N/m with a spool]; required with `mode: position`."""
    damping: Positive
    """Damping kd [N m s/rad, or N s/m]; a quick stop brakes with it, too."""
    ramp: NotNegative = 0.5
    """Time [s] in which the stiffness grows from 0 after enabling."""
    gear: Positive = 1.0
    """Turns of the motor's output per turn of the joint or spool; the motor's frames include its built-in gear."""
    spool_radius: Positive | None = None
    """Radius of the spool [m]; without one the drive turns a joint."""
    direction: Literal[1, -1] = 1
    """1 if the motor's angle grows with the value, else -1."""
    zero: Finite = 0.0
    """Value [rad or m] where the motor's angle is zero."""
    max_effort: Positive | None = None
    """Largest effort [N m or N] that is commanded; absent: the largest in a frame."""
    watch_time: Annotated[float, Field(ge=0.02, le=5.0)] = 0.15
    """A Damiao drive powers off by itself after this time [s] without a frame."""
    allow_no_watchdog: bool = False
    """Accept a drive that follows its last frame for ever when the HAL or the cable dies."""

    @model_validator(mode="after")
    def _fits(self) -> "MitSettings":
        try:
            layout, ranges = self.actuator
        except ConfigError as error:
            raise ValueError(str(error)) from None
        if self.mode == "position" and not self.stiffness:
            raise ValueError("`mode: position` needs a `stiffness` above 0.")
        if layout is Layout.MINI_CHEETAH and self.mode == "effort":
            raise ValueError("`mode: effort` is not possible: answers in the layout `mini_cheetah` carry no torque.")
        if layout is not Layout.DAMIAO and not self.allow_no_watchdog:
            raise ValueError(
                f"motor '{self.motor}' has no watchdog that can be set or read over CAN: when the HAL or the cable "
                "dies, it follows its last frame. If another circuit then cuts its power, set "
                "`allow_no_watchdog: true`."
            )
        scale = self.scale**2
        for name, value, most in (
            ("stiffness", self.stiffness, ranges.stiffness),
            ("damping", self.damping, ranges.damping),
        ):
            if value * scale > most:
                raise ValueError(f"{name} {value:g} is more than the motor's frames carry, at most {most / scale:g}.")
        return self

    @property
    def scale(self) -> float:
        """Value [rad or m] per radian of the motor."""
        return self.direction / self.gear * (self.spool_radius or 1.0)

    @property
    def actuator(self) -> tuple[Layout, Ranges]:
        """Layout and ranges of the motor: those of the table, overridden by `ranges`.

        Raises:
            ConfigError: The motor is not in the table, and `ranges` is not complete.
        """
        own = self.ranges
        if own.position and own.velocity and own.effort and own.layout:
            return own.layout, Ranges(
                own.position, own.velocity, own.effort, own.stiffness or 500.0, own.damping or 5.0
            )
        motor = mit_motors.motor(self.motor)
        table = motor.ranges
        return own.layout or motor.layout, Ranges(
            own.position or table.position,
            own.velocity or table.velocity,
            own.effort or table.effort,
            own.stiffness or table.stiffness,
            own.damping or table.damping,
        )
