"""Ranges, limits and possible values of a signal in a robot file, per element or one for all."""

from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from hal.calibration.units import check_units, factor


class Section(BaseModel):
    """A part of the robot file: frozen, unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Rate = Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
"""A rate [Hz] is at most what a loop in Python can reach."""
Finite = Annotated[float, Field(allow_inf_nan=False)]


def _refuse_nan(value: float) -> float:
    if value != value:
        raise ValueError("it must be a number, not NaN")
    return value


def per_element(value: float | tuple[float, ...] | None, size: int, where: str, default: float = np.nan) -> np.ndarray:
    """Return one value per element, shape (size,), from one value for all or one for each; `default` for None.

    Raises:
        ValueError: The number of values is not `size`.
    """
    array = np.asarray(default if value is None else value, float)
    if array.ndim and array.shape != (size,):
        raise ValueError(f"{where} has {array.size} values, the signal has {size}.")
    return np.broadcast_to(array, (size,)).copy()


class NumbersConfig(Section):
    """Numbers of one signal, in its unit unless the section declares another one."""

    TIMES: ClassVar[tuple[str, ...]] = ()
    """These numbers are times [s] in any case."""
    written_in: str | None = None
    """Unit of the numbers of this section, if it differs from that of the signal; rates are in this unit per second."""

    def in_unit(self, unit: str, where: str) -> Self:
        """Return these numbers in `unit`, that of their signal; `where` is their place in the robot file.

        Raises:
            ValueError: `written_in` cannot be converted to it.
        """
        if self.written_in is None:
            return self
        try:
            check_units(unit, self.written_in)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        scale = factor(unit, self.written_in)
        numbers = ((n, v) for n, v in self if isinstance(v, int | float | tuple) and n not in self.TIMES)
        scaled = {
            n: tuple(scale * v for v in value) if isinstance(value, tuple) else scale * value for n, value in numbers
        }
        return self.model_copy(update={**scaled, "written_in": None})


class RangeConfig(NumbersConfig):
    """Range of one signal, per element or one for all."""

    low: Finite | tuple[Finite, ...] | None = None
    high: Finite | tuple[Finite, ...] | None = None

    def bounds(self, size: int, where: str) -> tuple[np.ndarray, np.ndarray]:
        """Return lowest and highest value, each of shape (size,); infinite where not stated.

        Args:
            size: Number of elements of the signal.
            where: Place in the robot file, for error messages.

        Raises:
            ValueError: The number of values is not `size`, or low is not below high.
        """
        low = per_element(self.low, size, f"{where}.low", -np.inf)
        high = per_element(self.high, size, f"{where}.high", np.inf)
        if np.any(low >= high):
            raise ValueError(f"{where}: low must be below high in every element.")
        return low, high


class LimitConfig(RangeConfig):
    """Limits of a measured or commanded signal, per element or one for all."""

    rate: Positive | tuple[Positive, ...] | None = None
    """Largest change of a command [unit/s]: velocity if positions are commanded, acceleration if velocities are."""
    acceleration: Positive | tuple[Positive, ...] | None = None
    """Largest change of that rate [unit/s^2], for commanded positions."""
    soft_high: Positive | tuple[Positive, ...] | None = None
    """Measured load above which the command is relaxed: muscle tension, or effort of a drive in both directions."""
    trip_low: Finite | tuple[Finite, ...] | None = None
    """Measured value below which the robot stops and disables, such as the tension of a slack muscle."""
    trip_high: Finite | tuple[Finite, ...] | None = None
    """Measured value above which the robot stops and disables."""

    def check(self, size: int, where: str, is_commanded: bool) -> None:
        """Check that the limits of a signal of `size` elements are consistent.

        Raises:
            ValueError: They are not.
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
        """Whether the HAL must measure the signal."""
        return any(value is not None for value in (self.soft_high, self.trip_low, self.trip_high))


Bound = Annotated[float, AfterValidator(_refuse_nan)]
"""A bound may be infinite, which switches its check off."""
Above0 = Annotated[float, Field(gt=0)]
"""A positive number, also infinity."""


class PlausibleConfig(NumbersConfig):
    """Values that are physically possible, per element or one for all; each has a default from the limits."""

    TIMES: ClassVar[tuple[str, ...]] = ("frozen_after",)

    low: Bound | tuple[Bound, ...] | None = None
    """Lowest possible value [the signal's unit]."""
    high: Bound | tuple[Bound, ...] | None = None
    """Highest possible value."""
    rate: Above0 | tuple[Above0, ...] | None = None
    """Largest possible change [unit/s]."""
    frozen_after: Above0 | tuple[Above0, ...] | None = None
    """A value is frozen after this time [s] without a change of any bit while the robot is commanded to move."""

    def check(self, size: int, where: str) -> None:
        """Check the number of values, and that low is below high.

        Raises:
            ValueError: They are wrong.
        """
        low, high = (per_element(getattr(self, end), size, f"{where}.{end}") for end in ("low", "high"))
        if np.any(low >= high):
            raise ValueError(f"{where}: low must be below high in every element.")
        for label in ("rate", "frozen_after"):
            per_element(getattr(self, label), size, f"{where}.{label}")
