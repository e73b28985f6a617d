"""What the robot hands out each cycle: what was measured, and what was really sent."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hal.config import RobotConfig
from hal.device import Device
from hal.errors import ConfigError

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Sample:
    """One coherent cycle of the robot's sensors.

    Attributes:
        cycle: Number of the cycle, from 1.
        stamp_ns: Wall clock at the SYNC of the cycle [ns since 1970].
        source: `can` or `simulated`.
        complete: Whether every device answered in this cycle.
        values: Signal -> values [the signal's unit], shape (n,); NaN where not valid.
        age: Signal -> age of each value [s], shape (n,); inf if never measured.
        valid: Signal -> whether each value may be used, shape (n,).
    """

    cycle: int
    stamp_ns: int
    source: str
    complete: bool
    values: Arrays
    age: Arrays
    valid: Arrays


@dataclass(frozen=True, slots=True)
class Applied:
    """What was really sent to the drives in a cycle.

    Attributes:
        cycle: Number of the cycle, from 1.
        stamp_ns: Wall clock at the SYNC of the cycle [ns since 1970].
        mode: `off`, `enabling`, `hold`, `follow`, `stopping` or `fault`.
        signal: The commanded signal.
        desired: Newest accepted command [its unit], shape (n,); NaN if none is alive.
        values: Applied set-points [its unit], shape (n,); NaN while nothing is applied.
        limited_by: Which limits changed the command (`range`, `rate`, `tension`), sorted.
    """

    cycle: int
    stamp_ns: int
    mode: str
    signal: str
    desired: np.ndarray
    values: np.ndarray
    limited_by: list[str]


class Assembler:
    """Gathers the readings of all devices into the signals of the robot file, without a loop over elements."""

    def __init__(self, config: RobotConfig, devices: Sequence[Device]) -> None:
        """Work out where each device's values go.

        Raises:
            ConfigError: The devices measure an element twice, not at all, or one that the robot does not have.
        """
        names = config.element_names()
        measured = [element for device in devices for element in device.measures]
        wrong = sorted(set(names) ^ set(measured)) or sorted({e for e in measured if measured.count(e) > 1})
        if wrong:
            raise ConfigError(
                f"The devices of '{config.robot}' must measure each element once; that fails for {', '.join(wrong)}. "
                f"Elements of the robot file: {', '.join(names)}."
            )
        self._devices = tuple(device for device in devices if device.measures)
        place = {element: index for index, element in enumerate(measured)}
        self._order = np.array([place[name] for name in names])
        self._stale_after = np.repeat(
            [signal.stale_after for signal in config.signals.values()],
            [signal.size for signal in config.signals.values()],
        )
        self._slices: dict[str, slice] = {}
        start = 0
        for name, signal in config.signals.items():
            self._slices[name] = slice(start, start + signal.size)
            start += signal.size

    def assemble(self, now: float) -> tuple[Arrays, Arrays, Arrays]:
        """Values, ages [s] and validity of every signal at monotonic time `now` [s], in fresh arrays."""
        readings = [device.read() for device in self._devices]
        # The times first: a value that arrives in between then looks older than it is, never newer.
        received = np.concatenate([reading.received for reading in readings])[self._order]
        values = np.concatenate([reading.values for reading in readings])[self._order]
        age = np.maximum(now - received, 0.0)
        valid = (age <= self._stale_after) & np.isfinite(values)
        values[~valid] = np.nan
        slices = self._slices.items()
        return (
            {name: values[part] for name, part in slices},
            {name: age[part] for name, part in slices},
            {name: valid[part] for name, part in slices},
        )
