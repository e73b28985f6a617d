"""Repeated motions in recorded data: parts of recordings whose paths are nearly equal.

If a motion is repeated and only one of its repetitions is held out, a model is judged on a motion that it was trained
on, and the error is too small. Nearest neighbours of single samples do not reveal a repetition: a random motion of few
joints also comes back near every posture. Therefore whole paths are compared. The path of a part is searched for in all
other recordings by dynamic time warping with a free start and end: the speed may differ by a factor of two, and the
repetition may begin anywhere. A path is repeated if it is followed closely, and much more closely than in mirrored and
reversed copies of the recordings, in which a match is chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CLOSE = 0.25
"""A path that is repeated is followed with at most this root mean square error, as a share of its own spread."""
CHANCE = 0.25
"""A path that is repeated is followed with at most this share of the error that is reached by chance."""
NODES = 40
"""The path of a part of median length is described by this many means over time."""
FEWEST = 8
"""A part needs at least this many nodes to be compared."""
ALL_NODES = 8000
"""If all parts together have more nodes, each has fewer of them, but at least `FEWEST`."""
OVERLAP = 0.3
"""Two parts are of one motion if at least this share of the path of one lies in the other."""
BROAD = 1.5
"""A signal of fewer effective dimensions is not searched: paths on a line are followed closely by chance."""
SAMPLE, RARE = 200, 0.05
"""With more parts, this many are searched for first; all are if more than this share of them is repeated."""
BLOCK = 4_000_000
"""At most this many distances are computed at once."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of a recording.

    Attributes:
        recording: Index of the recording that it is cut from.
        rows: Samples, shape (rows, size), NaN where nothing was measured.
    """

    recording: int
    rows: np.ndarray


def repeated(pieces: Sequence[Piece]) -> np.ndarray:
    """Return the number of the motion of every piece, shape (pieces,); repetitions of a motion have the same number.

    Args:
        pieces: Parts of recordings in the order of time.
    """
    paths = _Paths.of(pieces)
    labels = np.arange(len(pieces))
    if paths is None:
        return labels
    queries = np.flatnonzero(paths.counts >= FEWEST)
    if len(queries) > SAMPLE:
        sample = queries[np.linspace(0, len(queries) - 1, SAMPLE).astype(int)]
        if len({query for query, _ in paths.matches(sample)}) <= RARE * SAMPLE:
            return labels
    for query, piece in paths.matches(queries):
        labels[labels == labels[piece]] = labels[query]
    return np.unique(labels, return_inverse=True)[1].ravel()


@dataclass(frozen=True, slots=True)
class _Paths:
    """Paths of all pieces.

    Attributes:
        nodes: Means over time on principal axes [standard deviations], piece after piece, shape (nodes, axes).
        counts: Number of nodes of each piece, shape (pieces,).
        recording: Index of the recording of each node, shape (nodes,).
    """

    nodes: np.ndarray
    counts: np.ndarray
    recording: np.ndarray

    @classmethod
    def of(cls, pieces: Sequence[Piece]) -> "_Paths | None":
        """Return the paths, or None if the samples are too few or lie on a line."""
        wanted = min(NODES, max(FEWEST, ALL_NODES // max(1, len(pieces))))
        step = max(1, int(np.median([len(piece.rows) for piece in pieces])) // wanted) if pieces else 1
        parts = [_means(piece.rows, step) for piece in pieces]
        nodes = np.concatenate(parts) if parts else np.zeros((0, 1))
        if len(nodes) < 2 * FEWEST:
            return None
        known = np.isfinite(nodes)
        amounts = np.maximum(known.sum(axis=0), 1)
        mean = np.where(known, nodes, 0.0).sum(axis=0) / amounts
        centred = np.where(known, nodes - mean, 0.0)
        spread = np.sqrt((centred**2).sum(axis=0) / amounts)
        varies = spread > 1e-9 * np.maximum(np.abs(mean), 1e-3)
        if not varies.any():
            return None
        centred = centred[:, varies] / spread[varies]
        strengths, axes = np.linalg.svd(centred, full_matrices=False)[1:]
        if (strengths**2).sum() ** 2 < BROAD * (strengths**4).sum():
            return None
        counts = np.array([len(part) for part in parts])
        return cls((centred @ axes.T).astype(np.float32), counts, np.repeat([p.recording for p in pieces], counts))

    @property
    def owner(self) -> np.ndarray:
        """Index of the piece of each node, shape (nodes,)."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    def matches(self, queries: np.ndarray) -> list[tuple[int, int]]:
        """Return pairs of pieces of which the first, one of the queries, repeats a part of the second."""
        pairs: list[tuple[int, int]] = []
        starts = np.cumsum(self.counts) - self.counts
        for count in np.unique(self.counts[queries]).tolist():
            same = queries[self.counts[queries] == count]
            for part in np.array_split(same, -(-len(same) * len(self.nodes) // BLOCK)):
                pairs += self._matches(part, np.stack([self.nodes[starts[q] : starts[q] + count] for q in part]))
        return pairs

    def _matches(self, queries: np.ndarray, paths: np.ndarray) -> list[tuple[int, int]]:
        """Return the matches of paths of one length, shape (queries, nodes, axes)."""
        owner, spread = self.owner, np.maximum(np.sqrt(paths.var(axis=1).sum(axis=-1)), 1e-6)
        own = owner[None, :] == queries[:, None]
        errors = _follow(paths, self.nodes, self.recording, own) / spread[:, None]
        candidates = np.flatnonzero(errors.min(axis=1) < CLOSE)
        if not len(candidates):
            return []
        chance = self._chance(paths[candidates], own[candidates]) / spread[candidates]
        pairs: list[tuple[int, int]] = []
        for query, limit in zip(candidates.tolist(), np.minimum(CLOSE, CHANCE * chance).tolist(), strict=True):
            for end in np.flatnonzero(errors[query] < limit).tolist():
                covered = owner[max(0, end + 1 - paths.shape[1]) : end + 1]
                covered = covered[self.recording[max(0, end + 1 - paths.shape[1]) : end + 1] == self.recording[end]]
                pieces, amounts = np.unique(covered, return_counts=True)
                chosen = pieces[amounts >= OVERLAP * len(covered)].tolist()
                pairs += [(int(queries[query]), piece) for piece in chosen if piece != queries[query]]
        return list(dict.fromkeys(pairs))

    def _chance(self, paths: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the error with which each path is followed in mirrored and reversed recordings, shape (queries,)."""
        size = self.nodes.shape[1]
        errors = []
        for axis in range(min(size, 3)):
            signs = np.ones(size, np.float32)
            signs[axis] = -1.0
            for order in (1, -1):
                mirrored = np.ascontiguousarray((self.nodes * signs)[::order])
                errors.append(_follow(paths, mirrored, self.recording[::order], own[:, ::order]).min(axis=1))
        return np.asarray(np.max(errors, axis=0))


def _means(rows: np.ndarray, step: int) -> np.ndarray:
    """Return means over `step` rows, shape (rows // step, size); NaN where nothing was measured."""
    count = len(rows) // step
    blocks = rows[: count * step].reshape(count, step, rows.shape[1])
    known = np.isfinite(blocks)
    amounts = known.sum(axis=1)
    return np.where(amounts > 0, np.where(known, blocks, 0.0).sum(axis=1) / np.maximum(amounts, 1), np.nan)


def _follow(paths: np.ndarray, nodes: np.ndarray, recording: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Follow paths in recordings by dynamic time warping.

    A step along the path is one or two nodes of the recording, or half a node.

    Args:
        paths: Paths, shape (queries, steps, axes).
        nodes: Nodes of all recordings, shape (nodes, axes).
        recording: Index of the recording of each node, shape (nodes,).
        own: Whether a node belongs to the path itself, shape (queries, nodes).

    Returns:
        Root mean square error of the best match that ends at each node, infinite where there is none, shape (queries,
        nodes).
    """
    norm = (nodes**2).sum(axis=1)
    blocked = np.where(own, np.float32(np.inf), np.float32(0.0))
    jumps = [recording[k:] != recording[:-k] for k in (1, 2)]

    def distance(step: int) -> np.ndarray:
        path = paths[:, step]
        squared = norm - 2.0 * (path @ nodes.T) + (path**2).sum(axis=1)[:, None]
        return np.maximum(squared, 0.0, out=squared) + blocked

    def moved(values: np.ndarray, by: int) -> np.ndarray:
        """Shift values to later nodes of the same recording."""
        shifted = np.full_like(values, np.inf)
        shifted[:, by:] = values[:, :-by]
        shifted[:, by:][:, jumps[by - 1]] = np.inf
        return shifted

    last = distance(0)
    total, before = last, np.full_like(last, np.inf)  # after the last step, and after the step before it
    for step in range(1, paths.shape[1]):
        now = distance(step)
        best = np.minimum(np.minimum(moved(total, 1), moved(total, 2)), moved(before, 1) + last)
        total, before, last = best + now, total, now
    return np.asarray(np.sqrt(total / paths.shape[1]))
