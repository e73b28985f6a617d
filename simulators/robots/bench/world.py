"""A world without a body: an element with a servo follows it, all others keep the values they were set to."""

import math
from collections.abc import Mapping

import numpy as np
from typing_extensions import override

from hal.config import RobotConfig
from simulators.faults import UnknownPart
from simulators.world import World

SET = "set"
BANDWIDTH = 30.0
"""The servos have this bandwidth [rad/s], a lag of a twentieth of a second."""


class BenchWorld(World):
    """One number per measured element; commanded ones begin in the middle of their range, all others at zero."""

    def __init__(self, config: RobotConfig) -> None:
        """Take signals and limits from a robot file."""
        self.time = 0.0
        self._places: dict[str, tuple[str, int]] = {}
        self._values: dict[str, np.ndarray] = {}
        for name in config.measured:
            low, high = config.bounds(name)
            has_middle = np.isfinite(low) & np.isfinite(high)
            self._values[name] = 0.5 * np.where(has_middle, low, 0.0) + 0.5 * np.where(has_middle, high, 0.0)
            for index, element in enumerate(config.signals[name].elements):
                self._places[f"{name}.{element}"] = (name, index)
        self._servos: dict[str, tuple[float, bool]] = {}

    @override
    def step(self, duration: float) -> None:
        self.time += duration
        share = 1.0 - math.exp(-BANDWIDTH * duration)
        for element, (target, enabled) in self._servos.items():
            if enabled:
                signal, index = self._places[element]
                values = self._values[signal]
                values[index] += share * (target - values[index])

    @override
    def measure(self) -> Mapping[str, np.ndarray]:
        return {name: values.copy() for name, values in self._values.items()}

    @override
    def truth(self) -> Mapping[str, np.ndarray]:
        return self.measure()

    @override
    def drive(self, element: str, target: float, enabled: bool) -> None:
        self._servos[element] = (target, enabled)

    @override
    def break_part(self, part: str) -> None:
        """Let an element read a value by `set:ELEMENT:VALUE` [its signal's unit], as in `set:muscle_tension.biceps:50`.

        Raises:
            UnknownPart: The part is something else.
        """
        kind, _, rest = part.partition(":")
        element, _, text = rest.partition(":")
        if kind != SET or element not in self._places:
            raise UnknownPart(f"A bench takes '{SET} ELEMENT VALUE'. Known elements: {', '.join(self._places)}.")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise UnknownPart(f"{element} cannot be set to '{text}', which is not a number.")
        signal, index = self._places[element]
        self._values[signal][index] = value

    @override
    def close(self) -> None:
        """Do nothing."""
