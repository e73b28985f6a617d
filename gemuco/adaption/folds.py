"""Parts of few data that are held out in turn, so that every row is judged by a model that did not learn from it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gemuco.dataset import Dataset, Episode

RECORDINGS = 5
"""A condition with at least this many recordings is divided by recordings."""
FOLDS = 5
"""Data are divided into at most this many parts."""
UNLIKE = 0.1
"""Rows are independent at a distance at which the autocorrelation of their recording is below this."""
BLOCK = 2
"""A part of a recording is at least this many correlation lengths long."""
ENOUGH = 15
"""Errors measured on fewer independent rows than this are mixed with the errors of the model before."""

Series = Sequence[tuple[int, np.ndarray]]
"""Each recording has the index of its condition and the indices of its rows, shape (n,)."""


@dataclass(frozen=True, slots=True)
class Folds:
    """Division of rows into parts.

    Attributes:
        part: Index of the part of every row, shape (rows,).
        count: Number of parts; 1 if there are too few rows to divide.
        independent: Number of independent rows.
    """

    part: np.ndarray
    count: int
    independent: float

    @property
    def doubt(self) -> float:
        """Weight of the errors of the model before, 0 to 1: few independent rows say little about other rows."""
        return max(0.0, 1.0 - self.independent / ENOUGH)

    def expected(self, after: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return the expected error of other rows.

        Args:
            after: Error of rows that a model did not learn from.
            before: Error of the model before on the same rows.
        """
        larger = np.maximum(after, before)
        mixed = np.sqrt((1.0 - self.doubt) * after**2 + self.doubt * larger**2)
        return np.asarray(self.widening * mixed)

    @property
    def widening(self) -> float:
        """Factor of a standard deviation from this number of independent rows, so that twice of it covers 95 %.

        It is the quantile of Student's t relative to that of the normal distribution, within 3 %.
        """
        freedom = max(2.0, self.independent)
        return 1.0 + 1.2 / freedom + 2.4 / freedom**2

    @classmethod
    def of(cls, rows: np.ndarray, series: Series) -> "Folds":
        """Divide every condition by its recordings, or by blocks of their rows if there are few.

        Args:
            rows: Rows [standard deviations], shape (n, size), NaN where not measured.
            series: The recordings.
        """
        part, independent, count = np.zeros(len(rows), int), 0.0, FOLDS
        for condition in {owner for owner, _ in series}:
            spans = [span for owner, span in series if owner == condition]
            lengths = [correlation_length(rows[span]) for span in spans]
            independent += sum(len(span) / length for span, length in zip(spans, lengths, strict=True))
            if len(spans) >= RECORDINGS:
                for index, span in enumerate(spans):
                    part[span] = index % FOLDS
                continue
            mine = np.concatenate(spans)
            blocks = min(FOLDS, max(2, len(mine) // (BLOCK * max(lengths))), max(1, len(mine) // 2))
            part[mine] = np.arange(len(mine)) * blocks // len(mine)
            count = min(count, blocks)
        return cls(part % count, count, independent)


def correlation_length(rows: np.ndarray) -> int:
    """Return the distance in rows at which the rows of a recording are independent, from its autocorrelation.

    Args:
        rows: Successive rows [standard deviations], shape (n, size), NaN where not measured.
    """
    known = np.isfinite(rows)
    mean = np.where(known, rows, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    deviation = np.where(known, rows - mean, 0.0)
    power = float(np.sum(deviation**2))
    for lag in range(1, len(rows)):
        if np.sum(deviation[lag:] * deviation[:-lag]) <= UNLIKE * power:
            return lag
    return max(1, len(rows))


def series_of(dataset: Dataset) -> list[tuple[int, np.ndarray]]:
    """Return the recordings of a dataset that contain rows."""
    counts = [len(dataset.layout.join(episode.values)) for episode in dataset.episodes]
    spans = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
    owners = [dataset.conditions.index(episode.condition) for episode in dataset.episodes]
    return [(owner, span) for owner, span in zip(owners, spans, strict=True) if len(span)]


def chosen(dataset: Dataset, choice: np.ndarray) -> Dataset:
    """Return the chosen rows of a dataset, truth values, shape (rows,), with an episode per uninterrupted series."""
    rows, episodes = dataset.rows(), []
    for owner, span in series_of(dataset):
        kept = span[choice[span]]
        for piece in np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1):
            if len(piece):
                episodes.append(Episode(dataset.conditions[owner], dataset.layout.split(rows[piece])))
    return Dataset(dataset.layout, tuple(episodes))
