"""Settings of servos on a serial line."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.config import Finite, Positive
from hal.drivers.bus_device import DeviceSettings
from hal.errors import ConfigError
from hal.protocols import dynamixel, dynamixel_models
from hal.protocols.dynamixel_models import Model

COUNTS = 4096
"""Counts per turn of both makes."""
MIDDLE = 2048


class SerialSettings(DeviceSettings):
    """Settings of servos of both makes."""

    gear: Positive = 1.0
    """Turns of the servo's output per turn of the joint or spool; its built-in gear does not count."""
    spool_radius: Positive | None = None
    """Radius of the spool [m]; without one the servo turns a joint."""
    direction: Literal[1, -1] = 1
    """1 if counts grow with the value, else -1."""
    zero: Finite = 0.0
    """Value [rad or m] at count 2048, the middle of the servo's turn."""
    allow_no_watchdog: bool = False
    """Accept a servo that stays under power when the HAL or the cable dies."""

    @property
    def scale(self) -> float:
        """Value [rad or m] per radian of the servo's output."""
        return self.direction / self.gear * (self.spool_radius or 1.0)

    @property
    def per_count(self) -> float:
        """Value [rad or m] per count."""
        return self.scale * 2.0 * math.pi / COUNTS

    def value(self, counts: float) -> float:
        """Return the value [rad or m] at a count."""
        return self.zero + self.per_count * (counts - MIDDLE)

    def counts(self, value: float) -> int:
        """Return the count at a value [rad or m]."""
        return round((value - self.zero) / self.per_count) + MIDDLE


class FeetechSettings(SerialSettings):
    """Settings of a Feetech servo of the STS or SMS series."""

    mode: Literal["position", "velocity"] = "position"
    """Commanded quantity."""
    acceleration: Annotated[int, Field(ge=1, le=254)] = 254
    """Register 41 [100 counts/s^2]. It is 0 after a restart, which is noticed by this."""
    torque_limit: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Register 48 [share of the largest torque]."""

    @model_validator(mode="after")
    def _has_other_stop(self) -> "FeetechSettings":
        if not self.allow_no_watchdog:
            raise ValueError(
                "Feetech servos have no watchdog: when the HAL or the cable dies, they stay under power and "
                + ("hold their last position" if self.mode == "position" else "continue at their last speed")
                + ". If another circuit then cuts their power, set `allow_no_watchdog: true`."
            )
        return self


class DynamixelSettings(SerialSettings):
    """Settings of a Dynamixel servo of the X series."""

    model: str
    """Name in the table of docs/devices.md."""
    mode: Literal["position", "velocity", "effort"] = "position"
    """Commanded quantity; effort needs `torque_constant`."""
    torque_constant: Positive | None = None
    """Torque per current at the servo's output [N m/A]; with it the current is measured as `effort`, too."""
    max_current: Positive | None = None
    """Largest current [A] with positions, for models that measure it."""
    damping: Positive | None = None
    """With `mode: effort`: damping of the stop behaviour `damp` [N m s/rad or N s/m]."""
    watch_time: Annotated[float, Field(ge=0.04, le=2.54)] = 0.2
    """The servo stops by itself after this time [s] without a packet, in steps of 0.02 s."""

    @model_validator(mode="after")
    def _fits(self) -> "DynamixelSettings":
        try:
            kind = self.kind
        except ConfigError as error:
            raise ValueError(str(error)) from None
        if kind.current_unit is None and (self.torque_constant or self.max_current or self.mode == "effort"):
            raise ValueError(f"model '{self.model}' has no current sensor, so it has no effort and no `max_current`.")
        if self.mode == "effort" and self.torque_constant is None:
            raise ValueError("`mode: effort` needs the `torque_constant` of the servo [N m/A].")
        if self.max_current and self.mode != "position":
            raise ValueError("`max_current` is for `mode: position`.")
        if not kind.stops_alone and not self.allow_no_watchdog:
            raise ValueError(
                f"the watchdog of '{self.model}' reports to have stopped a motor that it did not stop "
                "(docs/devices.md). If another circuit cuts the power when the HAL or the cable dies, set "
                "`allow_no_watchdog: true`."
            )
        return self

    @property
    def kind(self) -> Model:
        """Properties of the model.

        Raises:
            ConfigError: The model is unknown.
        """
        return dynamixel_models.model(self.model)

    @property
    def operating_mode(self) -> int:
        """Value of register 11."""
        return dynamixel.CURRENT_LIMITED_POSITION if self.max_current else dynamixel.MODES[self.mode]
