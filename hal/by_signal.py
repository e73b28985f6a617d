"""Values of all signals in one array, so that a loop handles one array instead of one per signal."""

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Self

import numpy as np

KEPT = 256
"""At most this number of `Elements` is cached; a robot has a handful."""
LONGEST = 1 << 14
"""Signals whose names have more characters in total are not cached; no robot has them."""


class Elements:
    """Number of elements of each signal, and their position in one array of all elements.

    `Elements.of` returns the same object for equal counts, up to `KEPT` of them, so that a caller can keep results by
    object.

    Attributes:
        counts: Signal -> number of elements, at least 1.
        places: Signal -> slice of the array.
        size: Number of elements of all signals.
    """

    __slots__ = ("_hash", "counts", "places", "size")
    _known: ClassVar[dict[tuple[object, ...], "Elements"]] = {}

    def __init__(self, counts: Mapping[str, float]) -> None:
        self.counts: dict[str, int] = {}
        self.places: dict[str, slice] = {}
        start = 0
        for name, count in counts.items():
            if not isinstance(name, str) or not isinstance(count, int | float) or not count >= 1 or count % 1:
                raise ValueError("Expected a map from signal to its number of elements, at least 1")
            self.counts[name] = int(count)
            self.places[name] = slice(start, start + int(count))
            start += int(count)
        self.size = start
        self._hash = hash(tuple(self.counts.items()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Elements) and list(self.counts.items()) == list(other.counts.items())

    def __hash__(self) -> int:
        return self._hash

    def __repr__(self) -> str:
        return f"Elements({self.counts})"

    @classmethod
    def of(cls, counts: Mapping[str, float]) -> "Elements":
        """Return the cached object with these counts.

        Raises:
            ValueError: The counts are not a map from names to whole numbers above 0.
        """
        try:
            return cls._known[(*counts, *counts.values())]
        except (KeyError, TypeError):  # a count that cannot be hashed is not a number: the constructor refuses it
            elements = cls(counts) if counts else NOTHING
        if len(cls._known) >= KEPT:
            cls._known.clear()
        if sum(map(len, counts)) <= LONGEST:
            cls._known[(*counts, *counts.values())] = elements
        return elements


NOTHING = Elements({})
"""No signal."""


class BySignal(Mapping[str, np.ndarray]):
    """Map from signal to array of shape (n,), a view of one array.

    Attributes:
        flat: Elements of all signals, signal after signal, shape (size,).
        elements: Position of each signal in `flat`.
    """

    __slots__ = ("elements", "flat")
    DTYPE: ClassVar[Any] = None
    """Data type of `flat`; any type if None."""

    def __init__(self, flat: np.ndarray, elements: Elements) -> None:
        self.flat, self.elements = flat, elements

    @classmethod
    def of(cls, values: Mapping[str, Any], elements: Elements | None = None) -> Self:
        """Join one array per signal, in the order of `elements` if they are given.

        Raises:
            ValueError: The signals or their sizes differ from `elements`.
        """
        if isinstance(values, BySignal) and (elements is None or values.elements is elements):
            return cls(np.asarray(values.flat, cls.DTYPE), values.elements)
        arrays = {name: np.atleast_1d(np.asarray(value, cls.DTYPE)) for name, value in values.items()}
        counts = {name: array.size for name, array in arrays.items()}
        if elements is None:
            elements = Elements.of(counts)
        if counts != elements.counts:
            raise ValueError(f"Expected signals with these numbers of elements: {elements.counts}; got {counts}")
        parts = [arrays[name] for name in elements.counts]
        return cls(np.concatenate(parts) if parts else np.zeros(0, cls.DTYPE), elements)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.flat[self.elements.places[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self.elements.places)

    def __len__(self) -> int:
        return len(self.elements.places)

    def __contains__(self, name: object) -> bool:
        return name in self.elements.places

    def __or__(self, other: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**self, **other}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({dict(self)})"


class Numbers(BySignal):
    """Map from signal to float64 array."""

    __slots__ = ()
    DTYPE = np.dtype("<f8")


class Truths(BySignal):
    """Map from signal to bool array."""

    __slots__ = ()
    DTYPE = np.dtype("?")
