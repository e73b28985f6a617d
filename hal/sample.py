"""Results of a cycle: the measured sample and the applied set-points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hal.by_signal import Elements, Numbers, Truths
from hal.computed import function_of
from hal.config import RobotConfig
from hal.device import Device
from hal.errors import ConfigError
from hal.safety.plausibility import Plausibility


@dataclass(frozen=True, slots=True)
class Sample:
    """One coherent cycle of the robot's sensors.

    Attributes:
        cycle: Number of the cycle, from 1.
        stamp_ns: Wall clock at the SYNC of the cycle [ns since 1970].
        source: `can`, `simulated`, or `ros2` if nodes of ROS 2 are its devices.
        complete: Whether every device answered in this cycle.
        values: Signal -> values [the signal's unit], shape (n,); NaN where not valid.
        age: Signal -> age of each value [s], shape (n,); inf before the first measurement.
        valid: Signal -> whether each value is fresh and finite, shape (n,).
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
    """Set-points that were sent to the drives in a cycle, after all limits.

    Attributes:
        cycle: Number of the cycle, from 1.
        stamp_ns: Wall clock at the SYNC of the cycle [ns since 1970].
        mode: `off`, `enabling`, `hold`, `follow`, `homing`, `stopping` or `fault`.
        signal: The commanded signal.
        desired: Newest accepted command [its unit], shape (n,); NaN without a command.
        values: Applied set-points [its unit], shape (n,); NaN if none were sent.
        limited_by: Active limits (`acceleration`, `effort`, `range`, `rate`, `tension`, `velocity`), sorted.
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
    """A computed signal: function, input elements, own elements, and highest age [s]."""

    function: Callable[[np.ndarray], np.ndarray]
    inputs: slice
    place: slice
    stale_after: float

    @property
    def size(self) -> int:
        """Number of elements."""
        return self.place.stop - self.place.start


class Assembler:
    """Assembler of the readings of all devices into the signals of the robot file, without a loop over elements.

    Attributes:
        plausibility: Check of every value that devices measure.
        heard: Signal -> fresh values of the newest sample, also those that are not plausible; NaN where there is none.
            Only what stops the robot may use them.
    """

    def __init__(self, config: RobotConfig, devices: Sequence[Device]) -> None:
        """Compute the place of each device's values in the sample.

        The sample has the signals of a camera only if a device measures them, as a simulator without a bus does.

        Raises:
            ConfigError: The devices measure an element twice, not at all, or measure an unknown element; or a signal
                cannot be computed.
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
        signals = [name for name, signal in config.signals.items() if name in direct or signal.computed is not None]
        self._elements = Elements.of({name: config.signals[name].size for name in signals})
        self.plausibility = Plausibility.of(config, direct, devices)
        self._origins = [device.origin for device in self._devices]
        self._places_of = [np.array([names.index(one) for one in device.measures]) for device in self._devices]
        self.heard = self.nothing
        places = self._elements.places
        self._direct = np.concatenate([np.r_[places[name]] for name in direct] or [np.zeros(0, int)])
        self._computed = [
            _Computed(function_of(config, name), places[signal.computed.inputs], places[name], signal.stale_after)
            for name, signal in config.signals.items()
            if name not in direct and signal.computed is not None
        ]

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals of a sample, in the order of the robot file."""
        return tuple(self._elements.counts)

    @property
    def nothing(self) -> Numbers:
        """NaN for every signal: the values before the first measurement."""
        return Numbers(np.full(self._elements.size, np.nan), self._elements)

    def assemble(self, now: float) -> tuple[Numbers, Numbers, Truths]:
        """Return values, ages [s] and validity of every signal at monotonic time `now` [s], in new arrays."""
        readings = [device.read() for device in self._devices]
        # Times before values: a value that arrives in between looks older than it is, never newer.
        received = np.concatenate([reading.received for reading in readings])
        values = np.concatenate([reading.values for reading in readings])
        if not self._is_in_order:
            received, values = received[self._order], values[self._order]
        age = np.maximum(now - received, 0.0)
        fresh = (age <= self._stale_after) & np.isfinite(values)
        np.copyto(values, np.nan, where=~fresh)
        origins = [device.origin for device in self._devices]
        if origins != self._origins:
            self._renew(origins)
        valid = self.plausibility.check(values, received, fresh)
        heard, doubted = values, None
        if valid is not fresh:
            doubted = fresh & ~valid
            heard = values.copy()
            np.copyto(values, np.nan, where=doubted)
        if self._computed:
            values, age, valid = self._with_computed(values, age, valid)
        self.heard = numbers = Numbers(values, self._elements)
        if doubted is not None:
            self.heard = Numbers(values.copy(), self._elements)
            self.heard.flat[self._direct[doubted]] = heard[doubted]
        return numbers, Numbers(age, self._elements), Truths(valid, self._elements)

    def _renew(self, origins: list[int]) -> None:
        """Let the elements of devices that were opened or homed begin anew."""
        for new, old, places in zip(origins, self._origins, self._places_of, strict=True):
            if new != old:
                self.plausibility.renew(places)
        self._origins = origins

    def _with_computed(self, values: np.ndarray, age: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return values, ages [s] and validity of all signals, measured and computed, in the order of a sample."""
        size, direct = self._elements.size, self._direct
        all_values, all_ages, all_valid = np.empty(size), np.empty(size), np.zeros(size, bool)
        all_values[direct], all_ages[direct], all_valid[direct] = values, age, valid
        for part in self._computed:
            place = part.place
            all_values[place], all_ages[place], all_valid[place] = _compute(
                part, all_values[part.inputs], all_ages[part.inputs]
            )
        return all_values, all_ages, all_valid


def _compute(part: _Computed, values: np.ndarray, age: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values, ages [s] and validity of a computed signal, which is as old as its oldest input.

    It is valid only if every input is valid.
    """
    oldest = max(age.tolist())
    ages = np.full(part.size, oldest)
    if oldest > part.stale_after or not np.isfinite(values).all():
        return np.full(part.size, np.nan), ages, np.zeros(part.size, bool)
    computed = np.array(part.function(values), float)
    valid = np.isfinite(computed)
    np.copyto(computed, np.nan, where=~valid)
    return computed, ages, valid
