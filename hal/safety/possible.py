"""Physically possible measurements: range, rate and stillness of each element, from the robot file."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hal.config import LimitConfig, PlausibleConfig, RobotConfig, per_element
from hal.device import Device
from hal.safety import feedback

FASTER = 4.0
"""A position may change at this multiple of its limited velocity, because it can be pushed and can overshoot."""
CROSSING = 0.1
"""A position without a known velocity takes at least this time [s] from one end of its range to the other."""
OVERLOAD = 2.0
"""A load may reach this multiple of the load at which the robot stops."""
UNDERLOAD = 0.02
"""A load that cannot be negative may read down to minus this part of the load at which the robot stops, by drift."""
LOAD_STEP = 0.25
"""A load that changes by more than this part of the load at which the robot stops, from one measurement to the next,
must be confirmed by a further measurement."""
RETURN_AFTER = 0.5
"""A position that jumped is measured again after this time [s] without a further jump."""
FROZEN_AFTER = 0.3
"""A measurement is frozen after this time [s] without a change of any bit while the robot is commanded to move."""
LOAD_QUANTITIES = ("force", "torque", "pressure")
"""Quantities of load cells begin with one of these words."""


@dataclass(frozen=True, slots=True)
class Possible:
    """Bounds of n measured elements.

    Attributes:
        names: `signal.element` of each.
        low: Lowest possible value [the signal's unit], shape (n,); -inf without one.
        high: Highest possible value, shape (n,); inf without one.
        rate: Largest possible change [unit/s], shape (n,); inf without one.
        return_after: Time without a jump after which a value is measured again [s], shape (n,).
        frozen_after: Time without a change of any bit, while commanded to move [s], shape (n,); inf without one.
        unloaded: A value up to this size may be constant while the robot moves, shape (n,): a load cell without load.
        own: Index of the commanded element of the same name, shape (n,); -1 without one.
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray
    return_after: np.ndarray
    frozen_after: np.ndarray
    unloaded: np.ndarray
    own: np.ndarray


def possible(config: RobotConfig, signals: Sequence[str], devices: Iterable[Device]) -> Possible:
    """Return the bounds of all elements of some signals, in order; `plausible` of the robot file has priority.

    Raises:
        ConfigError: `plausible` of a signal has a wrong number of values.
    """
    quantity_of = feedback.quantities(config, devices)
    commanded = config.signals[config.command.signal].elements
    names = config.element_names(signals)
    parts = [np.array(_of_signal(config, name, quantity_of)) for name in signals]  # each (6, size)
    low, high, rate, return_after, frozen_after, unloaded = np.concatenate([np.zeros((6, 0)), *parts], axis=1)
    elements = [name.partition(".")[2] for name in names]
    own = np.array([commanded.index(element) if element in commanded else -1 for element in elements], int)
    return Possible(tuple(names), low, high, rate, return_after, frozen_after, unloaded, own)


def _of_signal(config: RobotConfig, name: str, quantity_of: Mapping[str, str]) -> tuple[np.ndarray, ...]:
    """Return low, high, rate, return_after, frozen_after and unloaded of a signal, each of shape (n,)."""
    signal, limit = config.signals[name], config.limits.get(name, LimitConfig())
    size, where = signal.size, f"signals.{name}.plausible"
    quantities = {quantity_of.get(f"{name}.{element}", "") for element in signal.elements}
    top = _top(limit, size, name)
    is_load = np.isfinite(top).any() and (limit.soft_high is not None or _all_begin(quantities, LOAD_QUANTITIES))
    if is_load:
        low = np.minimum(-OVERLOAD * top if quantities == {"effort"} else -UNDERLOAD * top, _low_trip(limit, size, top))
        defaults = low, OVERLOAD * top, LOAD_STEP * top * config.rates.hal / 2.0
    else:
        low, high = config.bounds(name)
        span = high - low
        defaults = low - span, high + span, np.full(size, np.inf)
        if quantities == {"position"}:
            defaults = low - span, high + span, _position_rate(config, name, quantity_of)
    is_force = is_load or _all_begin(quantities, LOAD_QUANTITIES)
    watches = quantities == {"position"} or (is_load and quantities != {"effort"})
    given = signal.plausible or PlausibleConfig()
    low, high, rate = (
        np.where(np.isnan(own := per_element(value, size, f"{where}.{label}")), default, own)
        for label, value, default in zip(
            ("low", "high", "rate"), (given.low, given.high, given.rate), defaults, strict=True
        )
    )
    frozen = per_element(given.frozen_after, size, f"{where}.frozen_after", FROZEN_AFTER if watches else np.inf)
    unloaded = np.where(np.isfinite(high), 0.01 * np.abs(high), 0.0) if is_force else np.full(size, -1.0)
    return low, high, rate, np.full(size, 0.0 if is_force else RETURN_AFTER), frozen, unloaded


def _top(limit: LimitConfig, size: int, name: str) -> np.ndarray:
    """Return the load at which the robot stops, shape (size,): twice the soft limit without a trip, else inf."""
    trip = per_element(limit.trip_high, size, f"limits.{name}.trip_high", np.inf)
    soft = per_element(limit.soft_high, size, f"limits.{name}.soft_high", np.inf)
    return np.where(np.isfinite(trip), trip, 2.0 * soft)


def _low_trip(limit: LimitConfig, size: int, top: np.ndarray) -> np.ndarray:
    """Return a value far enough below `trip_low` that this trip can act, shape (size,); inf without one."""
    trip = per_element(limit.trip_low, size, "trip_low", np.inf)
    return np.where(trip < 0.0, trip - top, np.inf)


def _all_begin(quantities: set[str], words: tuple[str, ...]) -> bool:
    return bool(quantities) and all(quantity.startswith(words) for quantity in quantities)


def _position_rate(config: RobotConfig, name: str, quantity_of: Mapping[str, str]) -> np.ndarray:
    """Return the largest possible velocity of a position [unit/s], shape (n,), from its limits or a velocity's."""
    elements = config.signals[name].elements
    low, high = config.bounds(name)
    crossing = (high - low) / CROSSING
    known = np.full(len(elements), np.nan)
    if name == config.command.signal:
        known = per_element(config.limits.get(name, LimitConfig()).rate, len(elements), f"limits.{name}.rate")
    for signal in config.measured:
        ends = np.abs(np.stack(config.bounds(signal))).max(axis=0)
        for index, element in enumerate(config.signals[signal].elements):
            is_velocity = quantity_of.get(f"{signal}.{element}") == "velocity" and np.isfinite(ends[index])
            if is_velocity and element in elements:
                place = elements.index(element)
                known[place] = np.fmax(known[place], ends[index])
    return np.where(np.isfinite(known), FASTER * known, crossing)
