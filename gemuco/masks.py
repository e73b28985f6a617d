"""Feasible masks as sets of signal names (paper, II-A.1): the signals that are enough to infer the others."""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations

import numpy as np

from gemuco.errors import UnknownSignal

Mask = frozenset[str]


def all_masks(names: Sequence[str]) -> tuple[Mask, ...]:
    """Return every mask but the empty one, large ones first (the paper's M_all)."""
    sizes = range(len(names), 0, -1)
    return tuple(frozenset(combination) for size in sizes for combination in combinations(names, size))


def mask(names: Iterable[str], known: Sequence[str]) -> Mask:
    """Return a mask after a check of its names.

    Raises:
        UnknownSignal: A name is not a known signal.
    """
    signals = frozenset(names)
    for name in sorted(signals - set(known)):
        raise UnknownSignal(f"Mask names '{name}', which is not in the schema. Known signals: {', '.join(known)}.")
    return signals


def bits(signals: Mask, names: Sequence[str]) -> np.ndarray:
    """Return m as the network receives it: 1 for every name in the mask, else 0, shape (len(names),), float32."""
    return np.array([name in signals for name in names], np.float32)


def label(signals: Mask, names: Sequence[str]) -> str:
    """Return a mask as text: its names joined by `+`, in the order of `names`."""
    return "+".join(name for name in names if name in signals)


def covered_by(masks: Iterable[Mask], available: Iterable[str]) -> tuple[Mask, ...]:
    """Return the masks whose signals are all available."""
    names = frozenset(available)
    return tuple(m for m in masks if m <= names)


def best(masks: Iterable[Mask], available: Iterable[str], error: Callable[[Mask], float]) -> Mask | None:
    """Return the mask of the smallest error whose signals are all available; None if there is none."""
    covered = covered_by(masks, available)
    return min(covered, key=error) if covered else None
