"""Values that a room computes from a body schema once and keeps with it (`BodySchema.derived`)."""

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")
PATTERNS = 64
"""At most this many patterns of measured elements are kept per schema."""


class ByPattern(Generic[T]):
    """Values that depend on which elements of a sample are measured: a cache of at most `PATTERNS` patterns.

    Two threads may compute the same value at the same moment; the results are equal.
    """

    def __init__(self, compute: Callable[[np.ndarray], T]) -> None:
        self._compute = compute
        self._values: dict[bytes, T] = {}
        self._last: bytes | None = None

    def __call__(self, finite: np.ndarray) -> T:
        """Return the value for the finite elements of a sample, truth values, shape (size,)."""
        key = self._last = finite.tobytes()
        value = self._values.get(key)
        if value is None:
            value = self._compute(finite)
            if len(self._values) >= PATTERNS:
                self._values.clear()
            self._values[key] = value
        return value

    def is_ready(self, finite: np.ndarray) -> bool:
        """Whether the value for these finite elements is known; it is then the one that `follow` computes."""
        self._last = finite.tobytes()
        return self._last in self._values

    def follow(self, other: "ByPattern[T]") -> None:
        """Compute the value for the last pattern of another cache."""
        if other._last is not None:
            self(np.frombuffer(other._last, bool))
