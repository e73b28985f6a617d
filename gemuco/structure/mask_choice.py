"""Which of very many feasible masks to keep: those that serve best whatever signals happen to be available."""

import heapq

import numpy as np

SCENES = 1500
"""Random sets of available signals on which masks are compared."""


def choose(candidates: np.ndarray, errors: np.ndarray, outputs: np.ndarray, most: int, seed: int = 0) -> np.ndarray:
    """Pick masks one after another, each the one that lowers the mean error over the scenes most.

    If there is room, the masks of which no signal can be spared come first, so that whatever is enough is served.

    A scene is a set of available signals: all but one, or a random one with any share of the signals lost. Its error is
    that of the outputs it lacks under the best picked mask that it covers, and 1 (guess the mean) if it covers none.

    Args:
        candidates: Feasible masks, shape (n, signals), truth values.
        errors: Mean squared error of every signal under every mask [standard deviations squared], shape (n, signals).
        outputs: Which signals are outputs, truth values, shape (signals,).
        most: How many to pick.
        seed: Of the scenes.

    Returns:
        Indices of the picked masks in the order of their picking; fewer than `most` if more would serve no scene.
    """
    if len(candidates) <= most:
        return np.arange(len(candidates))
    scenes = _scenes(candidates.shape[1], seed)
    needed = (outputs & ~scenes).astype(np.float32)  # (scenes, signals)
    scenes, needed = scenes[needed.any(axis=1)], needed[needed.any(axis=1)]
    # Where no row tells (NaN) the mask does not serve; an error above 1 is worse than none.
    known = np.clip(np.nan_to_num(errors, nan=1.0), 0.0, 1.0).astype(np.float32)
    cost = known @ (needed / needed.sum(axis=1, keepdims=True)).T  # (candidates, scenes)
    cost[candidates.astype(np.float32) @ (~scenes).T.astype(np.float32) > 0.5] = 1.0
    least = np.ones(len(scenes), np.float32)
    smallest = (~candidates).astype(np.float32) @ candidates.T.astype(np.float32) < 0.5  # [i, j]: i contains j
    picked = np.flatnonzero(smallest.sum(axis=1) == 1).tolist()
    if len(picked) > most:
        picked = []
    elif picked:
        least = np.minimum(least, cost[picked].min(axis=0))
    # The more is picked the less there is to gain of any other: what a mask gained once is the most that it can gain.
    hopes = [(-float(gain), index) for index, gain in enumerate(np.maximum(least - cost, 0.0).sum(axis=1))]
    heapq.heapify(hopes)
    while len(picked) < most and hopes:
        _, best = heapq.heappop(hopes)
        hope = -float(np.maximum(least - cost[best], 0.0).sum()), best
        if hopes and hope > hopes[0]:
            heapq.heappush(hopes, hope)
        elif hope[0] >= 0.0:
            break
        else:
            picked.append(best)
            least = np.minimum(least, cost[best])
    return np.array(picked, int)


def _scenes(signals: int, seed: int) -> np.ndarray:
    """Sets of available signals, shape (scenes, signals), truth values."""
    random = np.random.default_rng(seed)
    shares = random.random((SCENES, 1))
    return np.concatenate([~np.eye(signals, dtype=bool), random.random((SCENES, signals)) < shares])
