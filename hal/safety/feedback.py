"""Measured elements that belong to commanded elements: their position, velocity or load."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from hal.config import RobotConfig, per_element
from hal.device import Device
from hal.errors import ConfigError

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Feedback:
    """Elements of a measured signal that belong to k commanded elements.

    Attributes:
        signal: Name of the measured signal.
        elements: Names of its k elements.
        commanded: Indices in the commanded signal, shape (k,).
        measured: Indices in the measured signal, shape (k,).
    """

    signal: str
    elements: tuple[str, ...]
    commanded: np.ndarray
    measured: np.ndarray

    def read(self, measured: Arrays) -> np.ndarray:
        """Return the newest values [unit of the measured signal], shape (k,)."""
        return measured[self.signal][self.measured]

    def unknown(self, measured: Arrays) -> list[str]:
        """Return the names of the elements without a valid value."""
        return [name for name, value in zip(self.elements, self.read(measured).tolist(), strict=True) if value != value]


@dataclass(frozen=True, slots=True)
class MeasuredRange(Feedback):
    """Position or velocity of commanded elements, with its range.

    Attributes:
        low: Lowest value allowed [unit of the measured signal], shape (k,); -inf without one.
        high: Highest value allowed, shape (k,); inf without one.
    """

    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True, slots=True)
class Load(Feedback):
    """Load of commanded elements, with its soft limit.

    Attributes:
        soft: Load above which the command moves towards relief [unit of the measured signal], shape (k,).
        hard: Load at which it does so at the highest speed, shape (k,).
        is_signed: Whether the load is the effort of a drive, which a motion against its sign relieves. Otherwise it is
            the tension of a wire, which a longer wire relieves.
    """

    soft: np.ndarray
    hard: np.ndarray
    is_signed: bool = False


def quantities(config: RobotConfig, devices: Iterable[Device]) -> dict[str, str]:
    """Return a map from `signal.element` to its quantity: `position`, `velocity`, `effort`, ..."""
    known = {element: quantity for entry in config.devices.values() for quantity, element in entry.elements.items()}
    for device in devices:
        known |= {element: quantity for quantity, element in device.served.items()}
    return known


def measured_ranges(config: RobotConfig, quantity_of: Mapping[str, str], quantity: str) -> list[MeasuredRange]:
    """Return the signals with a range that measure a quantity of commanded elements, matched by element name."""
    ranges = []
    for signal in config.measured:
        if signal in config.limits and signal != config.command.signal:
            pairs = [pair for pair in _pairs(config, signal) if quantity_of.get(f"{signal}.{pair[0]}") == quantity]
            low, high = config.bounds(signal)
            if pairs and (np.isfinite(low).any() or np.isfinite(high).any()):
                names, commanded, measured = zip(*pairs, strict=True)
                places = np.array(measured)
                ranges.append(MeasuredRange(signal, names, np.array(commanded), places, low[places], high[places]))
    return ranges


def check_known(config: RobotConfig, quantity_of: Mapping[str, str]) -> None:
    """Check that the quantity of every signal with a range is known.

    Raises:
        ConfigError: It is unknown whether a range limits a position, a velocity or another quantity.
    """
    for signal in config.measured:
        if signal != config.command.signal and np.isfinite(config.bounds(signal)).any():
            unknown = [name for name, _, _ in _pairs(config, signal) if f"{signal}.{name}" not in quantity_of]
            if unknown:
                raise ConfigError(
                    f"limits.{signal}: no device names the quantity of {', '.join(unknown)}, so this range cannot "
                    f"limit the commanded {config.command.signal}. Name it in the device's `elements`."
                )


def commanded_range(config: RobotConfig) -> MeasuredRange:
    """Return the range of the commanded signal, if it is a position."""
    name = config.command.signal
    places = np.arange(config.signals[name].size)
    return MeasuredRange(name, config.signals[name].elements, places, places, *config.bounds(name))


def loads(config: RobotConfig, quantity_of: Mapping[str, str], quantity: str) -> list[Load]:
    """Return the measured loads of commanded elements that have a soft limit.

    Raises:
        ConfigError: A soft limit can have no effect.
    """
    result = []
    for signal, limit in config.limits.items():
        if limit.soft_high is None:
            continue
        if signal == config.command.signal and quantity != "effort":
            raise ConfigError(f"limits.{signal}.soft_high: the signal is commanded; its limits are low, high and rate.")
        pairs = _pairs(config, signal)
        if not pairs:
            raise ConfigError(
                f"limits.{signal}.soft_high: no element has the name of an element of {config.command.signal}, so "
                "there is nothing to relax."
            )
        names, commanded, measured = zip(*pairs, strict=True)
        places = np.array(measured)
        size = config.signals[signal].size
        soft = per_element(limit.soft_high, size, f"limits.{signal}.soft_high")
        hard = per_element(limit.trip_high, size, f"limits.{signal}.trip_high")
        hard = np.where(np.isfinite(hard), hard, 2 * soft)
        signed = {quantity_of.get(f"{signal}.{name}") == "effort" for name in names}
        if len(signed) > 1:
            raise ConfigError(f"limits.{signal}.soft_high: drives measure some elements and load cells others.")
        result.append(Load(signal, names, np.array(commanded), places, soft[places], hard[places], signed.pop()))
    return result


def _pairs(config: RobotConfig, signal: str) -> list[tuple[str, int, int]]:
    """Return name, index in the commanded signal and index in `signal` of the elements that are in both."""
    names = config.signals[signal].elements
    commanded = config.signals[config.command.signal].elements
    return [(name, place, names.index(name)) for place, name in enumerate(commanded) if name in names]
