"""Search for the feasible masks of many signals without measuring all 2^n - 1, and choice of those that a schema keeps.

The search assumes that a superset of a mask that is enough is enough too, and that a subset of a mask that is not
enough is not. Then the border describes all masks: the smallest masks that are enough and the largest that are not. The
search (after MARCO: Liffiton et al., Fast, flexible MUS enumeration, 2016) measures a mask that the known border does
not decide. If it is enough, signals are removed while it stays enough; otherwise signals are added while it stays too
small. Each such walk ends on the border after n measurements. Many walks run together, so that their masks are measured
together.

The assumption only guides the search: every returned mask was measured. When the border is complete, its masks are
measured with one and with two signals less. New walks begin from each such mask that is enough against the assumption.
"""

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

TOGETHER = 32
"""This many walks run together."""
DEPTH = 2
"""Exceptions are searched for up to this many signals below the border."""
SEEDS = 4000
"""The border counts as complete when it decides all of this many random masks."""
SCENES = 1500
"""Masks are compared on this many random sets of available signals."""


@dataclass(frozen=True, slots=True)
class Border:
    """Result of the search.

    Attributes:
        smallest: Masks that are enough, and are not enough without any one of their signals, shape (n, signals).
        largest: Masks that are not enough, and are enough with any one more signal, shape (n, signals).
        tried: Number of masks that were measured.
        is_complete: Whether the search ended because nothing was left to measure, and not because of its budget.
    """

    smallest: np.ndarray
    largest: np.ndarray
    tried: int
    is_complete: bool


class _Oracle:
    """Memory of measured masks: the bytes of their truth values -> whether they are enough."""

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
        signals: Number of signals.
        budget: Approximate largest number of masks to measure.
        seed: Seed of the order of the walks.
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
    """Remove signals while the masks stay enough, or add signals while they stay too small."""
    masks = masks.copy()
    orders = random.permuted(np.tile(np.arange(masks.shape[1]), (len(masks), 1)), axis=1)
    for step in range(masks.shape[1]):
        rows = np.arange(len(masks))
        changed = masks[rows, orders[:, step]] == enough
        changed &= masks.sum(axis=1) > enough  # the empty mask is not allowed
        rows = rows[changed]
        if len(rows):
            tried = masks[rows]
            tried[np.arange(len(rows)), orders[rows, step]] = not enough
            stays = oracle(tried) == enough
            masks[rows[stays]] = tried[stays]
    return masks


def _unexplored(smallest: np.ndarray, largest: np.ndarray, signals: int, random: np.random.Generator) -> np.ndarray:
    """Draw masks that the border does not decide, shape (at most TOGETHER, signals)."""
    shares = random.random((SEEDS, 1))
    masks = np.unique(random.random((SEEDS, signals)) < shares, axis=0)
    masks = masks[masks.any(axis=1)]
    settled = _contains(masks, smallest) | _contains(~masks, ~largest)
    open_masks = masks[~settled]
    return open_masks[random.permutation(len(open_masks))[:TOGETHER]]


def _exceptions(smallest: np.ndarray, largest: np.ndarray, oracle: _Oracle) -> np.ndarray:
    """Find masks that are enough although they lack up to `DEPTH` signals of the border, shape (n, signals)."""
    short = np.concatenate([smallest, largest])
    for _ in range(DEPTH):
        lines, signals = np.nonzero(short)
        short = short[lines]
        short[np.arange(len(short)), signals] = False
        short = np.unique(short[short.any(axis=1)], axis=0)
        if not len(short):
            return short
        exceptions = short[oracle(short) & ~_contains(short, smallest)]
        if len(exceptions):
            return exceptions
    return exceptions


def _contains(masks: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Return whether each mask contains at least one of the parts, shape (masks,)."""
    lacking = parts.astype(np.float32) @ (~masks).T.astype(np.float32)  # (parts, masks): missing signals of the part
    return np.asarray((lacking < 0.5).any(axis=0)) if len(parts) else np.zeros(len(masks), bool)


def _extremes(masks: np.ndarray) -> np.ndarray:
    """Return the masks that contain no other mask of the array."""
    masks = np.unique(masks, axis=0)
    if not len(masks):
        return masks
    lacking = masks.astype(np.float32) @ (~masks).T.astype(np.float32)
    inside = lacking < 0.5  # [i, j]: i lies in j
    np.fill_diagonal(inside, False)
    return masks[~inside.any(axis=0)]


def choose(candidates: np.ndarray, errors: np.ndarray, outputs: np.ndarray, most: int, seed: int = 0) -> np.ndarray:
    """Choose masks one after another; each lowers the mean error over random scenes most.

    If there is room, the smallest masks come first, so that every set of signals that is enough has a mask.

    A scene is a set of available signals: all but one, or a random set that lacks any share of the signals. Its error
    is that of its missing outputs under the best chosen mask that it covers, and 1 (guess the mean) if it covers none.

    Args:
        candidates: Feasible masks, shape (n, signals), truth values.
        errors: Mean squared error of every signal under every mask [standard deviations squared], shape (n, signals).
        outputs: Whether each signal is an output, shape (signals,).
        most: Largest number of masks to choose.
        seed: Seed of the scenes.

    Returns:
        Indices of the chosen masks in the order of choice; fewer than `most` if more masks would improve no scene.
    """
    if len(candidates) <= most:
        return np.arange(len(candidates))
    scenes = _scenes(candidates.shape[1], seed)
    needed = (outputs & ~scenes).astype(np.float32)  # (scenes, signals)
    scenes, needed = scenes[needed.any(axis=1)], needed[needed.any(axis=1)]
    # A mask without a measured error (NaN) is as bad as guessing the mean, and so is an error above 1.
    known = np.clip(np.nan_to_num(errors, nan=1.0), 0.0, 1.0).astype(np.float32)
    cost = known @ (needed / needed.sum(axis=1, keepdims=True)).T  # (candidates, scenes)
    cost[candidates.astype(np.float32) @ (~scenes).T.astype(np.float32) > 0.5] = 1.0
    least = np.ones(len(scenes), np.float32)
    smallest = (~candidates).astype(np.float32) @ candidates.T.astype(np.float32) < 0.5  # [i, j]: i contains j
    chosen = np.flatnonzero(smallest.sum(axis=1) == 1).tolist()
    if len(chosen) > most:
        chosen = []
    elif chosen:
        least = np.minimum(least, cost[chosen].min(axis=0))
    # The gain of a mask only falls as others are chosen, so an old gain is an upper bound (lazy greedy).
    bounds = [(-float(gain), index) for index, gain in enumerate(np.maximum(least - cost, 0.0).sum(axis=1))]
    heapq.heapify(bounds)
    while len(chosen) < most and bounds:
        _, best = heapq.heappop(bounds)
        bound = -float(np.maximum(least - cost[best], 0.0).sum()), best
        if bounds and bound > bounds[0]:
            heapq.heappush(bounds, bound)
        elif bound[0] >= 0.0:
            break
        else:
            chosen.append(best)
            least = np.minimum(least, cost[best])
    return np.array(chosen, int)


def _scenes(signals: int, seed: int) -> np.ndarray:
    """Draw sets of available signals, shape (scenes, signals), truth values."""
    random = np.random.default_rng(seed)
    shares = random.random((SCENES, 1))
    return np.concatenate([~np.eye(signals, dtype=bool), random.random((SCENES, signals)) < shares])
