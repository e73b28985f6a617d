"""What is told of every signal, in one array: a loop that reads or sends it has one array to handle, not one each."""

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Self

import numpy as np

KEPT = 256
"""Sets of signals that are kept, so that equal ones are the same object; a robot has a handful."""
LONGEST = 1 << 14
"""Letters of all names together; longer ones, which no robot has, are not kept."""


class Elements:
    """How many elements each signal has, and where they lie in an array of all of them.

    Equal ones are the same object as long as `KEPT` suffices: what is worked out for one serves the next message too.

    Attributes:
        counts: Signal -> how many elements, at least one.
        places: Signal -> where they lie.
        size: How many there are in all.
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
        """The one with these counts.

        Raises:
            ValueError: They are no map from names to whole numbers above 0.
        """
        try:
            return cls._known[(*counts, *counts.values())]
        except (KeyError, TypeError):  # what cannot be a key is no number either
            found = cls(counts) if counts else NOTHING
        if len(cls._known) >= KEPT:
            cls._known.clear()
        if sum(map(len, counts)) <= LONGEST:
            cls._known[(*counts, *counts.values())] = found
        return found


NOTHING = Elements({})
"""No signal."""


class BySignal(Mapping[str, np.ndarray]):
    """Signal -> array, shape (n,): parts of one array.

    Attributes:
        flat: The elements of all signals one behind the other, shape (size,).
        elements: Which of them are whose.
    """

    __slots__ = ("elements", "flat")
    DTYPE: ClassVar[Any] = None
    """Kind of the numbers; any if None."""

    def __init__(self, flat: np.ndarray, elements: Elements) -> None:
        self.flat, self.elements = flat, elements

    @classmethod
    def of(cls, values: Mapping[str, Any], elements: Elements | None = None) -> Self:
        """From one array per signal, in the order of `elements` if they are given.

        Raises:
            ValueError: The signals or their sizes are not those of `elements`.
        """
        if isinstance(values, BySignal) and (elements is None or values.elements is elements):
            return cls(np.asarray(values.flat, cls.DTYPE), values.elements)
        arrays = {name: np.atleast_1d(np.asarray(value, cls.DTYPE)) for name, value in values.items()}
        counts = {name: array.size for name, array in arrays.items()}
        wanted = Elements.of(counts) if elements is None else elements
        if counts != wanted.counts:
            raise ValueError(f"Expected signals with so many elements: {wanted.counts}; these are {counts}")
        parts = [arrays[name] for name in wanted.counts]
        return cls(np.concatenate(parts) if parts else np.zeros(0, cls.DTYPE), wanted)

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
    """Of float64."""

    __slots__ = ()
    DTYPE = np.dtype("<f8")


class Truths(BySignal):
    """Of truth values."""

    __slots__ = ()
    DTYPE = np.dtype("?")
