"""Values that a room works out of a body schema once, kept with the schema (`BodySchema.derived`)."""

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")
PATTERNS = 64
"""At most this many patterns of measured elements are kept per schema."""


class ByPattern(Generic[T]):
    """Values that depend on which elements of a sample were measured, kept for at most `PATTERNS` patterns.

    Threads that ask at the same moment may each work the value out; the results are equal.
    """

    def __init__(self, work_out: Callable[[np.ndarray], T]) -> None:
        self._work_out = work_out
        self._kept: dict[bytes, T] = {}
        self._last: bytes | None = None

    def __call__(self, finite: np.ndarray) -> T:
        """Return the value for a pattern, truth values, shape (size,)."""
        key = self._last = finite.tobytes()
        kept = self._kept.get(key)
        if kept is None:
            kept = self._work_out(finite)
            if len(self._kept) >= PATTERNS:
                self._kept.clear()
            self._kept[key] = kept
        return kept

    def follow(self, other: "ByPattern[T]") -> None:
        """Work out the value for the pattern that another one was asked for last."""
        if other._last is not None:
            self(np.frombuffer(other._last, bool))
