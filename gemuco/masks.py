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
        UnknownSignal: A name is not among the known ones.
    """
    chosen = frozenset(names)
    for name in sorted(chosen - set(known)):
        raise UnknownSignal(f"Mask names '{name}', which is not in the schema. Known signals: {', '.join(known)}.")
    return chosen


def bits(chosen: Mask, names: Sequence[str]) -> np.ndarray:
    """Return the network's m of a mask: 1 where a signal is given, shape (len(names),), float32."""
    return np.array([name in chosen for name in names], np.float32)


def label(chosen: Mask, names: Sequence[str]) -> str:
    """Return the text of a mask: names joined by `+`, in the order of the layout."""
    return "+".join(name for name in names if name in chosen)


def covered_by(masks: Iterable[Mask], available: Iterable[str]) -> tuple[Mask, ...]:
    """Return the masks whose signals are all available."""
    names = frozenset(available)
    return tuple(m for m in masks if m <= names)


def best(masks: Iterable[Mask], available: Iterable[str], error: Callable[[Mask], float]) -> Mask | None:
    """Return the covered mask of the smallest error; None if no mask is covered."""
    covered = covered_by(masks, available)
    return min(covered, key=error) if covered else None
