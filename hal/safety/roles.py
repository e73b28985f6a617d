"""Which measured elements belong to which commanded ones, and as what: where they are, how fast, how loaded."""

from collections.abc import Iterable, Mapping

import numpy as np

from hal.config import RobotConfig, per_element
from hal.device import Device
from hal.errors import ConfigError
from hal.safety.ends import Way
from hal.safety.soft_effort import Load


def natures(config: RobotConfig, devices: Iterable[Device]) -> dict[str, str]:
    """`signal.element` -> what it is of its device: `position`, `velocity`, `effort`, ..."""
    found = {element: quantity for entry in config.devices.values() for quantity, element in entry.elements.items()}
    for device in devices:
        found |= {element: quantity for quantity, element in device.served.items()}
    return found


def ways(config: RobotConfig, nature: Mapping[str, str], quantity: str) -> list[Way]:
    """Signals that tell a quantity of commanded elements and have a range, by elements of the same name."""
    found = []
    for signal in config.measured:
        if signal in config.limits and signal != config.command.signal:
            pairs = [pair for pair in _namesakes(config, signal) if nature.get(f"{signal}.{pair[0]}") == quantity]
            low, high = config.bounds(signal)
            if pairs and (np.isfinite(low).any() or np.isfinite(high).any()):
                names, commanded, measured = zip(*pairs, strict=True)
                places = np.array(measured)
                found.append(Way(signal, names, np.array(commanded), places, low[places], high[places]))
    return found


def check_known(config: RobotConfig, nature: Mapping[str, str]) -> None:
    """Whether every range that may be meant to end a motion is of something known.

    Raises:
        ConfigError: Nobody can tell whether a range is of a position, a velocity or something else.
    """
    for signal in config.measured:
        if signal != config.command.signal and np.isfinite(config.bounds(signal)).any():
            unknown = [name for name, _, _ in _namesakes(config, signal) if f"{signal}.{name}" not in nature]
            if unknown:
                raise ConfigError(
                    f"limits.{signal}: no device says what {', '.join(unknown)} is of the commanded "
                    f"{config.command.signal}, so its range cannot act. Name it in the device's `elements`."
                )


def own_way(config: RobotConfig) -> Way:
    """The commanded signal itself, where it is a position."""
    name = config.command.signal
    places = np.arange(config.signals[name].size)
    return Way(name, config.signals[name].elements, places, places, *config.bounds(name))


def loads(config: RobotConfig, nature: Mapping[str, str], quantity: str) -> list[Load]:
    """What is measured of the commanded elements and has a soft limit.

    Raises:
        ConfigError: A soft limit that cannot act.
    """
    found = []
    for signal, limit in config.limits.items():
        if limit.soft_high is None:
            continue
        if signal == config.command.signal and quantity != "effort":
            raise ConfigError(f"limits.{signal}.soft_high: the signal is commanded; its limits are low, high and rate.")
        pairs = _namesakes(config, signal)
        if not pairs:
            raise ConfigError(
                f"limits.{signal}.soft_high: no element has the name of one of {config.command.signal}, so there is "
                "nothing to relax."
            )
        names, commanded, measured = zip(*pairs, strict=True)
        places = np.array(measured)
        size = config.signals[signal].size
        soft = per_element(limit.soft_high, size, f"limits.{signal}.soft_high")
        hard = per_element(limit.trip_high, size, f"limits.{signal}.trip_high")
        hard = np.where(np.isfinite(hard), hard, 2 * soft)
        signed = {nature.get(f"{signal}.{name}") == "effort" for name in names}
        if len(signed) > 1:
            raise ConfigError(f"limits.{signal}.soft_high: drives measure some elements and load cells others.")
        found.append(Load(signal, names, np.array(commanded), places, soft[places], hard[places], signed.pop()))
    return found


def _namesakes(config: RobotConfig, signal: str) -> list[tuple[str, int, int]]:
    """Name, place in the commanded signal and place in `signal` of elements that both have."""
    names = config.signals[signal].elements
    commanded = config.signals[config.command.signal].elements
    return [(name, place, names.index(name)) for place, name in enumerate(commanded) if name in names]
