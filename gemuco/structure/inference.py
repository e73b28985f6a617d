"""Search for the mask from which each signal is inferred best, and its error without selection bias.

All other signals together are not always the best mask: a network under that mask also follows inputs that say nothing
of the signal. The smallest of many measured errors is too small, because it is the smallest by chance too. Therefore a
mask is chosen on one half of the splits and its error is measured on the other half, and the reverse. With one split,
the two halves are stripes of its held-out rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gemuco.masks import all_masks, bits
from gemuco.structure.mask_errors import LISTED, MaskErrors

GAIN = 0.95
"""A mask replaces the mask of all others only if its error is below this share of theirs."""
STEP = 0.99
"""The removal of a signal must lower the error to this share."""


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Network and held-out rows of one split, with a memory of the masks that were measured.

    Attributes:
        errors: Network and rows.
        known: Bytes of a mask -> its errors, shape (signals,).
    """

    errors: MaskErrors
    known: dict[bytes, np.ndarray] = field(default_factory=dict)

    def of(self, masks: np.ndarray) -> np.ndarray:
        """Return the errors of masks, shape (masks, signals); see `MaskErrors.of`."""
        lines = [line.tobytes() for line in masks]
        new = list({text: index for index, text in enumerate(lines) if text not in self.known}.values())
        if new:
            self.known.update(zip((lines[i] for i in new), self.errors.of(masks[new]), strict=True))
        return np.array([self.known[text] for text in lines]).reshape(masks.shape)

    def halves(self) -> tuple["Split", "Split"]:
        """Return two halves of the rows."""
        one, other = self.errors.halves()
        return Split(one), Split(other)


@dataclass(frozen=True, slots=True, eq=False)
class Inference:
    """Errors of all signals, each inferred from its best mask.

    Attributes:
        masks: The best mask of each signal by all splits, truth values, shape (signals, signals).
        shares: Error of each signal by split, as a share of its variance, shape (splits, signals); NaN if unknown.
        squares: Mean square error over the elements of each signal by split [unit squared], shape (splits, signals).
    """

    masks: np.ndarray
    shares: np.ndarray
    squares: np.ndarray


def infer_best(splits: Sequence[Split]) -> Inference:
    """Choose the mask of each signal and measure it on splits on which it was not chosen."""
    units = list(splits) if len(splits) > 1 else list(splits[0].halves())
    sides = units[0::2], units[1::2]
    chosen = [_choose(side) for side in sides]
    shares, squares = [], []
    for index, unit in enumerate(units):
        masks = chosen[1 - index % 2]
        share, square = unit.of(masks).diagonal(), unit.errors.in_units(masks).diagonal()
        others = unit.errors.from_others()
        known = np.isfinite(share)
        shares.append(np.where(known, share, others))
        squares.append(np.where(known, square, others * _variances(unit.errors)))
    if len(splits) == 1:
        return Inference(_choose(units), mean_of(shares)[None], mean_of(squares)[None])
    return Inference(_choose(units), np.array(shares), np.array(squares))


def _choose(units: Sequence[Split]) -> np.ndarray:
    """Return the mask with the smallest mean error of each signal, truth values, shape (signals, signals)."""
    names = units[0].errors.layout.names
    return _of_all(units, names) if len(names) <= LISTED else _by_elimination(units, len(names))


def _of_all(units: Sequence[Split], names: tuple[str, ...]) -> np.ndarray:
    """Choose among all masks."""
    masks = np.array([bits(m, names) > 0 for m in all_masks(names)])
    error = mean_of([unit.of(masks) for unit in units])
    error = np.where(masks | ~np.isfinite(error), np.inf, error)
    chosen = ~np.eye(len(names), dtype=bool)
    largest = error[[np.flatnonzero((masks == line).all(axis=1))[0] for line in chosen], np.arange(len(names))]
    is_better = error.min(axis=0) < GAIN * largest
    chosen[is_better] = masks[error.argmin(axis=0)[is_better]]
    return chosen


def _by_elimination(units: Sequence[Split], size: int) -> np.ndarray:
    """Remove one signal after another from each mask while the error falls."""
    others = ~np.eye(size, dtype=bool)
    chosen, active = others.copy(), np.arange(size)
    start = np.nan_to_num(mean_of([unit.of(chosen) for unit in units]).diagonal(), nan=np.inf)
    error = start.copy()
    while len(active):
        owners, removed = np.nonzero(chosen[active])
        owners = active[owners]
        masks = chosen[owners]
        masks[np.arange(len(masks)), removed] = False
        owners, masks = owners[masks.any(axis=1)], masks[masks.any(axis=1)]
        if not len(masks):
            break
        values = mean_of([unit.of(masks) for unit in units])[np.arange(len(masks)), owners]
        values = np.nan_to_num(values, nan=np.inf)
        improved = []
        for signal in np.unique(owners).tolist():
            own = np.flatnonzero(owners == signal)
            best = own[values[own].argmin()]
            if values[best] < STEP * error[signal]:
                chosen[signal], error[signal] = masks[best], values[best]
                improved.append(signal)
        active = np.array(improved, int)
    return np.where((error < GAIN * start)[:, None], chosen, others)


def _variances(unit: MaskErrors) -> np.ndarray:
    """Return the mean variance over the live elements of each signal [unit squared], shape (signals,)."""
    live = unit.liveliness > 0.0
    return unit.by_signal(unit.liveliness * unit.scale**2) / np.maximum(unit.by_signal(live.astype(float)), 1.0)


def mean_of(parts: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    """Return the mean of the known values; NaN where none is known."""
    values = np.array(parts)
    known = np.isfinite(values)
    amounts = known.sum(axis=0)
    return np.where(amounts > 0, np.where(known, values, 0.0).sum(axis=0) / np.maximum(amounts, 1), np.nan)
