"""Feasible masks of many signals without trying all 2^n - 1: walk the border between too little and enough.

Whether a mask is enough hardly ever depends on more than this: a superset of what is enough is enough, a subset of what
is too little is too little. So the border says all: the smallest masks that are enough and the largest that are not.
The search (after MARCO: Liffiton et al., Fast, flexible MUS enumeration, 2016) takes a mask about which the border
found so far says nothing, tries it, and if it is enough takes signals away while it stays so, else adds signals while
it stays too little. Each such walk ends on the border and is n tries long; walks are taken many at a time, so that
their tries are evaluated together.

The assumption only guides: every mask that is returned was tried itself, and when the border is complete its masks are
tried with one signal less and with two, for exceptions from which new walks begin.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

TOGETHER = 32
"""Walks at a time."""
DEPTH = 2
"""How far below the border exceptions are looked for."""
SEEDS = 4000
"""Random masks looked through for one that the border says nothing about, before the border counts as complete."""


@dataclass(frozen=True, slots=True)
class Border:
    """What the search found.

    Attributes:
        smallest: Masks that are enough and of which no signal can be spared, shape (n, signals).
        largest: Masks that are too little, to which no signal can be added, shape (n, signals).
        tried: How many masks were evaluated.
        is_complete: Whether the search ended because nothing was left to look at, not for its budget.
    """

    smallest: np.ndarray
    largest: np.ndarray
    tried: int
    is_complete: bool


class _Oracle:
    """Remembers what was tried: line of truth values -> whether it is enough."""

    def __init__(self, is_enough: Callable[[np.ndarray], np.ndarray]) -> None:
        self._is_enough = is_enough
        self.known: dict[bytes, bool] = {}

    def __call__(self, bits: np.ndarray) -> np.ndarray:
        lines = np.unique(bits, axis=0)
        new = lines[[line.tobytes() not in self.known for line in lines]]
        if len(new):
            self.known.update(zip((line.tobytes() for line in new), map(bool, self._is_enough(new)), strict=True))
        return np.array([self.known[line.tobytes()] for line in bits])


def find_border(is_enough: Callable[[np.ndarray], np.ndarray], signals: int, budget: int, seed: int = 0) -> Border:
    """Walk until the border is complete or the budget is spent.

    Args:
        is_enough: Masks (n, signals), truth values -> whether each is enough, shape (n,).
        signals: How many there are.
        budget: About how many masks to try at most.
        seed: Of the order of the walks.
    """
    random = np.random.default_rng(seed)
    oracle = _Oracle(is_enough)
    smallest = np.zeros((0, signals), bool)
    largest = np.zeros((0, signals), bool)
    while len(oracle.known) < budget:
        seeds = _unexplored(smallest, largest, signals, random)
        if not len(seeds):
            seeds = _exceptions(smallest, largest, oracle)
        if not len(seeds):
            return Border(smallest, largest, len(oracle.known), True)
        enough = oracle(seeds)
        smallest = _extremes(np.concatenate([smallest, _walk(seeds[enough], oracle, random, enough=True)]))
        largest = ~_extremes(~np.concatenate([largest, _walk(seeds[~enough], oracle, random, enough=False)]))
    return Border(smallest, largest, len(oracle.known), False)


def _walk(masks: np.ndarray, oracle: _Oracle, random: np.random.Generator, enough: bool) -> np.ndarray:
    """Take signals away while the masks stay enough, or add signals while they stay too little."""
    masks = masks.copy()
    orders = random.permuted(np.tile(np.arange(masks.shape[1]), (len(masks), 1)), axis=1)
    for step in range(masks.shape[1]):
        rows = np.arange(len(masks))
        changed = masks[rows, orders[:, step]] == enough
        changed &= masks.sum(axis=1) > enough  # the empty mask is none
        rows = rows[changed]
        if len(rows):
            tried = masks[rows]
            tried[np.arange(len(rows)), orders[rows, step]] = not enough
            stays = oracle(tried) == enough
            masks[rows[stays]] = tried[stays]
    return masks


def _unexplored(smallest: np.ndarray, largest: np.ndarray, signals: int, random: np.random.Generator) -> np.ndarray:
    """Masks that contain none of the smallest and lie in none of the largest, shape (at most TOGETHER, signals)."""
    shares = random.random((SEEDS, 1))
    masks = np.unique(random.random((SEEDS, signals)) < shares, axis=0)
    masks = masks[masks.any(axis=1)]
    settled = _contains(masks, smallest) | _contains(~masks, ~largest)
    open_masks = masks[~settled]
    return open_masks[random.permutation(len(open_masks))[:TOGETHER]]


def _exceptions(smallest: np.ndarray, largest: np.ndarray, oracle: _Oracle) -> np.ndarray:
    """Masks up to `DEPTH` signals short of the border that are enough all the same, shape (n, signals)."""
    short = np.concatenate([smallest, largest])
    for _ in range(DEPTH):
        lines, signals = np.nonzero(short)
        short = short[lines]
        short[np.arange(len(short)), signals] = False
        short = np.unique(short[short.any(axis=1)], axis=0)
        if not len(short):
            return short
        found = short[oracle(short) & ~_contains(short, smallest)]
        if len(found):
            return found
    return found


def _contains(masks: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Whether each mask contains at least one of the parts, shape (masks,)."""
    lacking = parts.astype(np.float32) @ (~masks).T.astype(np.float32)  # (parts, masks): signals of a part not there
    return np.asarray((lacking < 0.5).any(axis=0)) if len(parts) else np.zeros(len(masks), bool)


def _extremes(masks: np.ndarray) -> np.ndarray:
    """The masks that contain no other of them."""
    masks = np.unique(masks, axis=0)
    if not len(masks):
        return masks
    lacking = masks.astype(np.float32) @ (~masks).T.astype(np.float32)
    inside = lacking < 0.5  # [i, j]: i lies in j
    np.fill_diagonal(inside, False)
    return masks[~inside.any(axis=0)]
