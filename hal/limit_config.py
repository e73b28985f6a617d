"""What a robot file says of what is allowed, and of how the robot stops."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from hal.section import Finite, Positive, Section


def per_element(value: float | tuple[float, ...] | None, size: int, where: str, default: float = np.nan) -> np.ndarray:
    """One value per element, shape (size,), of one for all or one for each; `default` where nothing is stated.

    Raises:
        ValueError: Another number of values.
    """
    array = np.asarray(default if value is None else value, float)
    if array.ndim and array.shape != (size,):
        raise ValueError(f"{where} has {array.size} values, the signal has {size}.")
    return np.broadcast_to(array, (size,)).copy()


class RangeConfig(Section):
    """Bounds of one signal, per element or one for all."""

    low: Finite | tuple[Finite, ...] | None = None
    high: Finite | tuple[Finite, ...] | None = None

    def bounds(self, size: int, where: str) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest value, each of shape (size,); infinite where not stated.

        Args:
            size: How many elements the signal has.
            where: Named in what is raised.

        Raises:
            ValueError: Another number of values, or low is not below high.
        """
        low = per_element(self.low, size, f"{where}.low", -np.inf)
        high = per_element(self.high, size, f"{where}.high", np.inf)
        if np.any(low >= high):
            raise ValueError(f"{where}: low must be below high in every element.")
        return low, high


class LimitConfig(RangeConfig):
    """What of a signal is allowed, per element or one for all. For a command: what may be applied."""

    rate: Positive | tuple[Positive, ...] | None = None
    """Largest change of a command [unit/s]: of a position its velocity, of a velocity its acceleration."""
    acceleration: Positive | tuple[Positive, ...] | None = None
    """Largest change of that rate [unit/s^2], for commanded positions."""
    soft_high: Positive | tuple[Positive, ...] | None = None
    """Measured load above which the command is relaxed: tension of a muscle, effort of a drive in either direction."""
    trip_low: Finite | tuple[Finite, ...] | None = None
    """Measured value below which the robot stops and disables, such as the tension of a slack muscle."""
    trip_high: Finite | tuple[Finite, ...] | None = None
    """Measured value above which the robot stops and disables."""

    def check(self, size: int, where: str, is_commanded: bool) -> None:
        """Whether the limits of a signal of `size` elements fit each other.

        Raises:
            ValueError: They do not.
        """
        self.bounds(size, where)
        ladder = [
            (label, per_element(getattr(self, label), size, f"{where}.{label}"))
            for label in ("trip_low", "low", "high", "soft_high", "trip_high")
        ]
        for index, (lower, below) in enumerate(ladder):
            for upper, above in ladder[index + 1 :]:
                if (lower, upper) != ("high", "soft_high") and np.any(below >= above):
                    raise ValueError(f"{where}: {lower} must be below {upper}.")
        for label in ("rate", "acceleration"):
            per_element(getattr(self, label), size, f"{where}.{label}")
            if getattr(self, label) is not None and not is_commanded:
                raise ValueError(f"{where}.{label} is of a command, but this signal is not the commanded one.")

    @property
    def is_watched(self) -> bool:
        """Whether the HAL has to see the signal."""
        return any(value is not None for value in (self.soft_high, self.trip_low, self.trip_high))


class CommandConfig(Section):
    """Which signal is commanded, how long a command lives, and what happens when none comes."""

    signal: str
    time_to_live: Annotated[float, Field(gt=0, le=10)] = 0.1
    """Age [s] of a command beyond which it is not followed any more."""
    hold: Annotated[float, Field(ge=0)] = 1.0
    """How long [s] the last applied command is held before the robot stops; how long a stop holds or damps."""


class StopConfig(Section):
    """What the robot does when it is asked to stop, or when no command comes any more."""

    behaviour: Literal["hold", "damp", "park", "off"] = "hold"
    """`hold` its place for `command.hold` and let go; `damp` its motion for as long and let go; `park`: move slowly to
    a safe posture and let go; `off`: let go at once."""
    park: tuple[Finite, ...] | None = None
    """The safe posture [unit of the commanded signal]."""
    speed: Positive | None = None
    """Highest speed on the way there [unit/s]."""

    @model_validator(mode="after")
    def _says_where(self) -> "StopConfig":
        parks = self.behaviour == "park"
        if parks and (self.park is None or self.speed is None):
            raise ValueError("to park, say where (`park`, a value per element) and how fast (`speed`).")
        if not parks and (self.park is not None or self.speed is not None):
            raise ValueError(f"`park` and `speed` are for the behaviour park, not for '{self.behaviour}'.")
        return self
