"""Division of the recordings of one condition into parts, and the choice of the parts that are held out.

Parts are whole recordings, or blocks of time if there are few recordings. Repetitions of a motion are held out together
(`gemuco.splits.repeats`). Successive seeds hold out other motions until each was held out once, so that the errors of a
few splits describe all data. The rows beside a held-out block are used for neither training nor measurement.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from gemuco.splits.repeats import Piece, repeated

MIN_RECORDINGS = 5
"""Fewer recordings than this are cut into blocks of time."""
FEWEST_BLOCKS, MOST_BLOCKS = 20, 40
"""The recordings of a condition are cut into this many blocks, if they have enough samples."""
BLOCK = 10
"""A block is at least this many times as long as the signals remember, if there can be `FEWEST_BLOCKS` of them."""
GAP = 4
"""A gap is at most one part in this many of a block."""
ORDERS = 2
"""The motions are held out in this many orders, one after the other, so that the same data are held out by any seeds
that cover them all: by ten successive ones if a fifth is held out."""
FORGOTTEN = 0.37
"""Signals are forgotten after the number of rows at which their autocorrelation is below this."""


@dataclass(frozen=True, slots=True)
class Part:
    """Rows `start` to `stop` of a recording."""

    recording: int
    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


@dataclass(frozen=True, slots=True, eq=False)
class Division:
    """Parts of the recordings of one condition.

    Attributes:
        parts: The parts in the order of recordings and time.
        motions: Number of the motion of every part, shape (parts,); repetitions of a motion have the same number.
        gap: Number of rows beside a held-out block that are not used.
        everywhere: Signals whose path is the same in all parts although the paths of other signals differ.
    """

    parts: tuple[Part, ...]
    motions: np.ndarray
    gap: int
    everywhere: tuple[str, ...]

    @classmethod
    def of(cls, recordings: Sequence[np.ndarray], spans: Mapping[str, slice]) -> "Division":
        """Divide recordings.

        Args:
            recordings: Samples of each recording, shape (samples, size), NaN where nothing was measured.
            spans: Signal -> its columns.
        """
        memory = max((_memory(rows) for rows in recordings), default=1)
        total = sum(map(len, recordings))
        if len(recordings) >= MIN_RECORDINGS:
            parts, gap = [Part(index, 0, len(rows)) for index, rows in enumerate(recordings) if len(rows)], 0
        else:
            count = min(max(total // (BLOCK * memory), FEWEST_BLOCKS), MOST_BLOCKS)
            parts = [part for index, rows in enumerate(recordings) for part in _blocks(index, rows, count, total)]
            gap = min(memory, min(map(len, parts), default=0) // GAP)
        motions, everywhere = _motions(recordings, parts, spans)
        return cls(tuple(parts), motions, gap, everywhere)

    @property
    def is_one_motion(self) -> bool:
        """Whether all parts repeat one motion, so that no motion can be held out."""
        return len(self.parts) > 1 and not self.motions.any()

    @property
    def largest(self) -> int | None:
        """Number of the motion that has more than half of the rows and is never held out; None if there is none."""
        if self.is_one_motion or not len(self.parts):
            return None
        rows = np.bincount(self.motions, [len(part) for part in self.parts])
        return int(rows.argmax()) if 2 * rows.max() > rows.sum() else None

    def held(self, share: float, seed: int) -> set[int]:
        """Return the indices of the parts to hold out.

        Args:
            share: Share of the motions to hold out, 0 to 1; at least one motion is held out and one is not.
            seed: Seed of the draw. Successive seeds hold out all motions in turn, in one order and then in another.
        """
        motions = np.arange(len(self.parts)) if self.is_one_motion else self.motions
        candidates = np.setdiff1d(motions, [] if self.largest is None else [self.largest])
        count = min(max(1, round(share * len(candidates))), len(candidates) - (self.largest is None))
        turns = -(-len(candidates) // count)
        order = np.random.default_rng(seed // turns % ORDERS).permutation(candidates)
        chosen = np.take(order, np.arange(count) + (seed % turns) * count, mode="wrap")
        return set(np.flatnonzero(np.isin(motions, chosen)).tolist())

    def trained(self, held: set[int]) -> list[Part]:
        """Return the other parts without the gaps beside held-out parts of the same recording."""
        parts: list[Part] = []
        for index, part in enumerate(self.parts):
            if index in held:
                continue
            before, after = (
                self.gap * (i in held and self.parts[i].recording == part.recording) for i in (index - 1, index + 1)
            )
            parts.append(Part(part.recording, part.start + before, part.stop - after))
        return parts

    def notes(self, condition: str) -> list[str]:
        """Return sentences on repeated motions for the user."""
        sizes = np.bincount(self.motions)
        kind = "blocks of time" if self._is_cut else "episodes"
        if self.is_one_motion:
            return [
                f"All {len(self.parts)} {kind} of condition '{condition}' repeat one motion: the held-out data repeat "
                "the training data, and the errors hold for this motion only. Record other motions."
            ]
        if len(sizes) == len(self.parts):
            return []
        repeats = " and ".join(str(size) for size in sorted(sizes[sizes > 1].tolist(), reverse=True))
        text = (
            f"Condition '{condition}' repeats motions: its {len(self.parts)} {kind} are {len(sizes)} motions "
            f"({repeats} {kind} are nearly equal). Repetitions are held out together."
        )
        if self.largest is not None:
            text += " The motion with more than half of the data is always trained on."
        if self.everywhere:
            text += f" The path of {' and '.join(self.everywhere)} is the same everywhere: no other one is held out."
        return [text]

    @property
    def _is_cut(self) -> bool:
        return len({part.recording for part in self.parts}) < len(self.parts)


def _memory(rows: np.ndarray) -> int:
    """Return the number of rows after which the signals are forgotten, at least 1."""
    known = np.isfinite(rows)
    amounts = np.maximum(known.sum(axis=0), 1)
    centred = np.where(known, rows - np.where(known, rows, 0.0).sum(axis=0) / amounts, 0.0)
    spread = np.sqrt((centred**2).sum(axis=0) / amounts)
    x = centred[:, spread > 0.0] / spread[spread > 0.0]
    if len(x) < 4 or not x.shape[1]:
        return 1
    spectrum = np.abs(np.fft.rfft(x, 2 * len(x), axis=0)) ** 2
    correlation = np.fft.irfft(spectrum.mean(axis=1))[: len(x)] / len(x)
    below = np.flatnonzero(correlation < FORGOTTEN * correlation[0])
    return max(1, int(below[0])) if len(below) else len(x)


def _blocks(recording: int, rows: np.ndarray, count: int, total: int) -> list[Part]:
    """Cut a recording into its share of `count` blocks of at least two rows; one row is a block if it must be."""
    alone = len(rows) == total
    own = min(
        max(1, round(count * len(rows) / max(total, 1))), max(len(rows) // 2, 2 if alone and len(rows) > 1 else 1)
    )
    edges = np.linspace(0, len(rows), own + 1).round().astype(int).tolist()
    return [Part(recording, start, stop) for start, stop in pairwise(edges) if stop > start]


def _motions(
    recordings: Sequence[np.ndarray], parts: Sequence[Part], spans: Mapping[str, slice]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the motion of every part, and the signals whose path is the same in all parts.

    Two parts are of one motion if the path of all signals, or of any one signal, is repeated. A signal that repeats the
    same path everywhere (a command that was always the same) cannot be held out and does not join the others.
    """

    def labels(span: slice) -> np.ndarray:
        return repeated([Piece(p.recording, recordings[p.recording][p.start : p.stop, span]) for p in parts])

    whole = labels(slice(None))
    if len(parts) < 2 or not whole.any() or len(spans) == 1:
        return whole, ()
    merged, everywhere = whole, []
    for name, span in spans.items():
        own = labels(span)
        if own.any():
            merged = _joined(merged, own)
        else:
            everywhere.append(name)
    return (merged, tuple(everywhere)) if merged.any() else (whole, tuple(everywhere))


def _joined(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the finest grouping that keeps the groups of both together."""
    labels = one.copy()
    for group in np.unique(other):
        touched = np.unique(labels[other == group])
        labels[np.isin(labels, touched)] = touched[0]
    return np.unique(labels, return_inverse=True)[1].ravel()
