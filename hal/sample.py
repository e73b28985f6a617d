"""What the robot hands out each cycle: what was measured, and what was really sent."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hal.by_signal import Elements, Numbers, Truths
from hal.computed import function_of
from hal.config import RobotConfig
from hal.device import Device
from hal.errors import ConfigError


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
    values: Numbers
    age: Numbers
    valid: Truths


@dataclass(frozen=True, slots=True)
class Applied:
    """What was really sent to the drives in a cycle.

    Attributes:
        cycle: Number of the cycle, from 1.
        stamp_ns: Wall clock at the SYNC of the cycle [ns since 1970].
        mode: `off`, `enabling`, `hold`, `follow`, `homing`, `stopping` or `fault`.
        signal: The commanded signal.
        desired: Newest accepted command [its unit], shape (n,); NaN if none is alive.
        values: Applied set-points [its unit], shape (n,); NaN while nothing is applied.
        limited_by: Which limits acted (`acceleration`, `effort`, `range`, `rate`, `tension`, `velocity`), sorted.
    """

    cycle: int
    stamp_ns: int
    mode: str
    signal: str
    desired: np.ndarray
    values: np.ndarray
    limited_by: list[str]


@dataclass(frozen=True, slots=True)
class _Computed:
    """A signal that is computed: how, from which elements, where it belongs, and until what age [s]."""

    function: Callable[[np.ndarray], np.ndarray]
    inputs: slice
    place: slice
    stale_after: float

    @property
    def size(self) -> int:
        """How many elements it has."""
        return self.place.stop - self.place.start


class Assembler:
    """Gathers the readings of all devices into the signals of the robot file, without a loop over elements."""

    def __init__(self, config: RobotConfig, devices: Sequence[Device]) -> None:
        """Work out where each device's values go.

        Signals that a camera's process publishes are served only where a device measures them, as a simulator without
        a bus does.

        Raises:
            ConfigError: The devices measure an element twice, not at all, or one that the robot does not have; or a
                signal cannot be computed.
        """
        measured = [element for device in devices for element in device.measures]
        seen = [name for name in config.seen if any(e in measured for e in config.element_names([name]))]
        direct = [name for name in config.signals if name in config.measured or name in seen]
        names = config.element_names(direct)
        wrong = sorted(set(names) ^ set(measured)) or sorted({e for e in measured if measured.count(e) > 1})
        if wrong:
            raise ConfigError(
                f"The devices of '{config.robot}' must measure each element once; that fails for {', '.join(wrong)}. "
                f"Elements of the robot file: {', '.join(names)}."
            )
        self._devices = tuple(device for device in devices if device.measures)
        place = {element: index for index, element in enumerate(measured)}
        self._order = np.array([place[name] for name in names])
        self._is_in_order = bool((self._order == np.arange(len(names))).all())
        self._stale_after = np.repeat(
            [config.signals[name].stale_after for name in direct], [config.signals[name].size for name in direct]
        )
        has = [name for name, signal in config.signals.items() if name in direct or signal.computed is not None]
        self._elements = Elements.of({name: config.signals[name].size for name in has})
        places = self._elements.places
        self._direct = np.concatenate([np.r_[places[name]] for name in direct] or [np.zeros(0, int)])
        self._computed = [
            _Computed(function_of(config, name), places[signal.computed.inputs], places[name], signal.stale_after)
            for name, signal in config.signals.items()
            if name not in direct and signal.computed is not None
        ]

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals that a sample has, in the order of the robot file."""
        return tuple(self._elements.counts)

    @property
    def nothing(self) -> Numbers:
        """Values of every signal as long as nothing was measured."""
        return Numbers(np.full(self._elements.size, np.nan), self._elements)

    def assemble(self, now: float) -> tuple[Numbers, Numbers, Truths]:
        """Values, ages [s] and validity of every signal at monotonic time `now` [s], in fresh arrays."""
        readings = [device.read() for device in self._devices]
        # The times first: a value that arrives in between then looks older than it is, never newer.
        received = np.concatenate([reading.received for reading in readings])
        values = np.concatenate([reading.values for reading in readings])
        if not self._is_in_order:
            received, values = received[self._order], values[self._order]
        age = np.maximum(now - received, 0.0)
        valid = (age <= self._stale_after) & np.isfinite(values)
        np.copyto(values, np.nan, where=~valid)
        if self._computed:
            values, age, valid = self._with_computed(values, age, valid)
        return Numbers(values, self._elements), Numbers(age, self._elements), Truths(valid, self._elements)

    def _with_computed(self, values: np.ndarray, age: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, ...]:
        """With what is computed put between what was measured."""
        size, direct = self._elements.size, self._direct
        all_values, all_ages, all_valid = np.empty(size), np.empty(size), np.zeros(size, bool)
        all_values[direct], all_ages[direct], all_valid[direct] = values, age, valid
        for one in self._computed:
            into = one.place
            all_values[into], all_ages[into], all_valid[into] = _compute(
                one, all_values[one.inputs], all_ages[one.inputs]
            )
        return all_values, all_ages, all_valid


def _compute(part: _Computed, values: np.ndarray, age: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values, ages [s] and validity of a computed signal: valid only if every input is, and as old as the oldest."""
    oldest = max(age.tolist())
    ages = np.full(part.size, oldest)
    if oldest > part.stale_after or not np.isfinite(values).all():
        return np.full(part.size, np.nan), ages, np.zeros(part.size, bool)
    computed = np.array(part.function(values), float)
    valid = np.isfinite(computed)
    np.copyto(computed, np.nan, where=~valid)
    return computed, ages, valid
