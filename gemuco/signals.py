"""Signals, which are named vectors, and their layout in one long vector."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Integral

import numpy as np

from gemuco.errors import UnknownSignal, WrongKind, WrongSize, check_kind, described


@dataclass(frozen=True, slots=True)
class Signal:
    """A named vector of sensor or control values (the paper's x_i).

    Attributes:
        name: Such as `joint_position`.
        size: Number of elements.
        unit: SI unit of every element.
        elements: Names of the elements; numbered if not given.
    """

    name: str
    size: int
    unit: str
    elements: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_kind("The name of a signal", self.name, str, "text")
        check_kind(f"The size of signal '{self.name}'", self.size, Integral, "a whole number")
        check_kind(f"The unit of signal '{self.name}'", self.unit, str, "text, such as 'rad'")
        check_kind(f"The elements of signal '{self.name}'", self.elements, (tuple, list), "a tuple of names")
        if self.size < 1:
            raise WrongSize(f"Signal '{self.name}' has {self.size} elements; it needs at least one.")
        object.__setattr__(self, "elements", tuple(self.elements) or tuple(str(i) for i in range(self.size)))
        if len(self.elements) != self.size:
            raise WrongSize(f"Signal '{self.name}' has {self.size} elements but {len(self.elements)} element names.")


def check_samples(samples: object) -> None:
    """Refuse anything but a sequence of samples.

    Raises:
        WrongKind: The argument is a single sample or no sequence.
    """
    if isinstance(samples, Mapping | str) or not isinstance(samples, Iterable):
        raise WrongKind(f"Samples must be a list of mappings of signal -> array, not {described(samples)}.")


@dataclass(frozen=True, slots=True)
class Layout:
    """Signals in a fixed order, and the position of each in the vector of all elements.

    Attributes:
        signals: The signals in their order.
        names: Names of the signals.
        size: Number of elements of all signals together.
        slices: Signal -> its slice of the vector.
    """

    signals: tuple[Signal, ...]
    names: tuple[str, ...] = field(init=False, compare=False, repr=False)
    size: int = field(init=False, compare=False, repr=False)
    slices: dict[str, slice] = field(init=False, compare=False, repr=False)
    _starts: np.ndarray = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        check_kind("The signals of a layout", self.signals, (tuple, list), "a tuple of Signal")
        object.__setattr__(self, "signals", tuple(self.signals))
        slices: dict[str, slice] = {}
        start = 0
        for signal in self.signals:
            check_kind("Every entry of a layout", signal, Signal, "a Signal")
            if signal.name in slices:
                raise UnknownSignal(f"Signal '{signal.name}' is in the layout twice; names must differ.")
            slices[signal.name] = slice(start, start + signal.size)
            start += signal.size
        object.__setattr__(self, "names", tuple(slices))
        object.__setattr__(self, "size", start)
        object.__setattr__(self, "slices", slices)
        object.__setattr__(self, "_starts", np.array([span.start for span in slices.values()], int))

    def slice(self, name: str) -> slice:
        """Return a signal's slice of the vector.

        Raises:
            UnknownSignal: No signal has this name.
        """
        try:
            return self.slices[name]
        except KeyError:
            known = ", ".join(self.names)
            raise UnknownSignal(f"Signal '{name}' is not in the schema. Known signals: {known}.") from None

    def signal(self, name: str) -> Signal:
        """Return the signal with a name."""
        self.slice(name)
        return self.signals[self.names.index(name)]

    def subset(self, names: Iterable[str]) -> "Layout":
        """Return the layout of the named signals, in the order of this layout."""
        selection = set(names)
        for name in selection:
            self.slice(name)
        return Layout(tuple(signal for signal in self.signals if signal.name in selection))

    def indices(self, names: Iterable[str]) -> np.ndarray:
        """Return the positions of the elements of the named signals, in the order of the layout, shape (n,)."""
        subset = self.subset(names)
        parts = [np.arange(self.slices[name].start, self.slices[name].stop) for name in subset.names]
        return np.concatenate(parts) if parts else np.zeros(0, int)

    def element(self, index: int) -> str:
        """Return the name `signal.element` of a position in the vector."""
        for signal in self.signals:
            span = self.slices[signal.name]
            if span.start <= index < span.stop:
                return f"{signal.name}.{signal.elements[index - span.start]}"
        raise UnknownSignal(f"Element {index} is outside of the layout of {self.size} elements.")

    def join(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Join named arrays into one vector.

        Args:
            values: Signal -> array [its unit], shape (n,) or (samples, n). Absent signals become NaN.

        Returns:
            Shape (size,) or (samples, size), float64.

        Raises:
            UnknownSignal: A name is not in this layout.
            WrongSize: An array does not have its signal's size, or has another number of samples than the others.
            WrongKind: The values are not a mapping.
        """
        try:
            return self._join_sample(values)
        except (AttributeError, KeyError, TypeError, ValueError):
            return self._join_any(values)

    def _join_sample(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Join one sample of arrays of the right shape, fast, as loops need it; raise an error for anything else."""
        joined = np.empty(self.size)
        joined.fill(np.nan)
        for name, value in values.items():
            span = self.slices[name]
            if value.shape != (span.stop - span.start,):
                raise ValueError
            joined[span] = value
        return joined

    def _join_any(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Join values of any allowed form, or raise an error with a clear message."""
        if not isinstance(values, Mapping):
            raise WrongKind(f"Values must be a mapping of signal -> array, not {described(values)}.")
        arrays: dict[str, np.ndarray] = {}
        leading: tuple[int, ...] | None = None
        for name, value in values.items():
            span = self.slice(name)
            size = span.stop - span.start
            try:
                array = np.asarray(value, float)
            except (TypeError, ValueError):
                raise WrongSize(f"Signal '{name}' needs {size} numbers, not {described(value)}.") from None
            if array.ndim not in (1, 2) or array.shape[-1] != size:
                raise WrongSize(f"Signal '{name}' has {size} elements, but the array has shape {array.shape}.")
            if leading is not None and array.shape[:-1] != leading:
                raise WrongSize(
                    f"Signal '{name}' has shape {array.shape}; the signals before it have {leading} samples."
                )
            leading = array.shape[:-1]
            arrays[name] = array
        joined = np.full((*(leading or ()), self.size), np.nan)
        for name, array in arrays.items():
            joined[..., self.slices[name]] = array
        return joined

    def join_one(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Join one sample, shape (size,).

        Raises:
            WrongSize: Several samples were given, or an array does not have its signal's size.
        """
        joined = self.join(values)
        if joined.ndim != 1:
            raise WrongSize(
                f"One sample at a time is allowed, an array of shape (n,) per signal; there are {len(joined)} samples. "
                "Give them one after the other."
            )
        return joined

    def split(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        """Split a vector, shape (..., size), into signal -> array, shape (..., n). The arrays are views."""
        if vector.shape[-1] != self.size:
            raise WrongSize(f"The layout has {self.size} elements, but the array has shape {vector.shape}.")
        return {name: vector[..., span] for name, span in self.slices.items()}

    def whole(self, finite: np.ndarray) -> frozenset[str]:
        """Return the signals whose elements are all finite; `finite` has a truth value per element, shape (size,)."""
        if not self.signals:
            return frozenset()
        complete = np.logical_and.reduceat(finite, self._starts).tolist()
        return frozenset(name for name, is_complete in zip(self.slices, complete, strict=True) if is_complete)
