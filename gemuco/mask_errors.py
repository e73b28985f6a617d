"""How badly one network infers every signal from any mask, measured on held-out rows."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gemuco import batched, cores, devices, outliers
from gemuco.compiled.chain import pack
from gemuco.compiled.masks import squares, sums
from gemuco.dataset import Dataset
from gemuco.kernels import Chain
from gemuco.material import Material
from gemuco.scaler import CLIP
from gemuco.schema import BodySchema
from gemuco.signals import Layout
from gemuco.task import Task

RARE = 0.05
"""An outlier is rare: where more than this share of a signal would be, the model is wrong, and all counts."""
TOLD = 30
"""An error of single rows is an estimate where at least so many tell of every living element."""
TOGETHER = 2_000_000
"""So many squared errors of single rows are held at a time by all cores, about."""


@dataclass(frozen=True, slots=True, eq=False)
class MaskErrors:
    """A network that infers every signal from any mask, and rows to try it on.

    Errors are shares of variance: 1 is what always guessing the mean costs. For elements that vary, this is the mean
    squared error in standard deviations. An element that hardly moves (below the floor of its signal's scale) counts as
    little as it moves, and one that never does not at all, or dead channels would make a signal look well inferred.

    Attributes:
        layout: The signals.
        chain: The network: all signals, a bit per signal and p in, all signals out.
        x: Held-out rows [standard deviations], clipped, gaps filled by zero, shape (rows, size).
        there: Which elements count: measured, and alive; shape (rows, size).
        whole: Which signals are whole, shape (rows, signals).
        p: Parametric bias of every row, shape (rows, bias_size).
        liveliness: Variance of every element in the training data, at most 1 [standard deviations squared], (size,).
    """

    layout: Layout
    chain: Chain
    x: np.ndarray
    there: np.ndarray
    whole: np.ndarray
    p: np.ndarray
    liveliness: np.ndarray

    @classmethod
    def of_schema(cls, schema: BodySchema, train: Dataset, held: Dataset, limit: float) -> "MaskErrors":
        """For a schema whose inputs and outputs are all signals, on samples that it was not trained on.

        Each sample is judged under the p of its condition. Outliers (`TrainConfig.outliers`) do not count.
        """
        layout, scaler = schema.layout, schema.scaler
        x = scaler.normalise(held.rows())
        p = np.zeros((len(x), len(schema.bias)), np.float32)
        if len(schema.bias):
            p = np.stack([schema.biases[c] for c in held.conditions])[held.condition_of_rows()]
        task = Task(layout, schema.masks, schema.x_out)
        material = Material(task, x, held.condition_of_rows(), scaler)
        wild = outliers.find(material, schema.weights, p, limit)
        wild[:, wild.mean(axis=0) > RARE] = False
        there = np.isfinite(x) & ~wild[:, task.signal_of]
        granted = there.copy()
        granted[:, scaler.dead] = True  # what is stuck hinders no mask
        there[:, scaler.dead] = False
        whole = np.stack([granted[:, layout.slice(name)].all(axis=1) for name in layout.names], axis=1)
        known = scaler.normalise(train.rows())
        liveliness = np.zeros(layout.size)
        for element in np.setdiff1d(np.arange(layout.size), scaler.dead):
            liveliness[element] = min(1.0, float(np.nanvar(known[:, element])))
        x = np.clip(np.where(there, x, 0.0), -CLIP, CLIP).astype(np.float32)
        return cls(layout, schema.weights.whole, x, there, whole, p, liveliness)

    def thinned(self, rows: int) -> "MaskErrors":
        """On at most so many rows, evenly chosen: a quicker and rougher judgement."""
        if len(self.x) <= rows:
            return self
        return self._rows(np.linspace(0, len(self.x) - 1, rows).astype(int))

    def drawn(self, rows: int, seed: int = 0) -> "MaskErrors":
        """On so many rows at random; those of fewer are among those of more."""
        return self._rows(np.random.default_rng(seed).permutation(len(self.x))[:rows])

    def of(self, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors under masks.

        Args:
            bits: One mask per line, shape (masks, signals), truth values.

        Returns:
            Share of the variance of every signal that every mask leaves unexplained, shape (masks, signals), NaN where
            no row tells; and `amounts`.
        """
        squared, count = self._squared(bits)
        measured = self._by_signal(np.where(count > 0, self.liveliness, 0.0))
        missed = self._by_signal(squared / np.maximum(count, 1))
        return np.where(measured > 0, missed / np.maximum(measured, 1e-12), np.nan), self.amounts

    def by_row(self, bits: np.ndarray) -> np.ndarray:
        """What every row adds to the errors of `of`, which are means over rows, shape (masks, rows, signals).

        NaN for a signal that has a living element of which fewer than `TOLD` rows tell.
        """
        rows, *_ = self._arrays()
        chain, found = pack(self.chain), np.empty((len(bits), *self.whole.shape), np.float32)

        def measure(part: slice) -> None:
            squared = squares(chain, rows, self.x, *self._gates(bits[part]))
            told = self._usable(bits[part]).T[:, :, None] & self.there  # (masks, rows, size)
            count = told.sum(axis=1, keepdims=True)
            measured = self._by_signal(np.where(count > 0, self.liveliness, 0.0))
            scarce = self._by_signal((count < TOLD) & (self.liveliness > 0.0)) > 0
            shares = self._by_signal(squared * told * (len(rows) / np.maximum(count, 1)).astype(np.float32))
            found[part] = np.where(scarce, np.nan, shares / np.maximum(measured, 1e-12))

        most = TOGETHER // max(1, self.x.size) // cores.count()
        cores.run([partial(measure, part) for part in _parts(len(bits), most)])
        return found

    def from_others(self, signal: int) -> float:
        """Error of a signal (by its index) from all others; NaN if no row tells.

        Where no row has all of them, every row that has the signal is inferred from whatever others it has.
        """
        others = np.arange(len(self.layout.names)) != signal
        whole = float(self.of(others[None])[0][0, signal])
        if np.isfinite(whole):
            return whole
        span = self.layout.slice(self.layout.names[signal])
        total, count = np.zeros(self.layout.size), np.zeros(self.layout.size)
        patterns, which = np.unique(self.whole & others, axis=0, return_inverse=True)
        for index in np.flatnonzero(patterns.any(axis=1)):
            part = self._rows(np.flatnonzero(which.ravel() == index))
            squared, rows = part._squared(patterns[index : index + 1])
            total, count = total + squared[0], count + rows[0]
        known = self.liveliness[span] * (count[span] > 0)
        return float((total[span] / np.maximum(count[span], 1)).sum() / known.sum()) if known.any() else float("nan")

    @property
    def amounts(self) -> np.ndarray:
        """How much of each signal there is to explain, shape (signals,): its elements, if all vary."""
        return self._by_signal(self.liveliness)

    @property
    def _sizes(self) -> list[int]:
        return [signal.size for signal in self.layout.signals]

    def _rows(self, chosen: np.ndarray) -> "MaskErrors":
        return replace(self, **{name: getattr(self, name)[chosen] for name in ("x", "there", "whole", "p")})

    def _by_signal(self, elements: np.ndarray) -> np.ndarray:
        """Sums over the elements of every signal, shape (..., size) -> (..., signals)."""
        return np.asarray(np.add.reduceat(elements, np.cumsum([0, *self._sizes[:-1]]), axis=-1))

    def _squared(self, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sum of squared errors of every element, and of how many rows, shapes (masks, size)."""
        rows, known, whole = self._arrays()
        chain, device = pack(self.chain), devices.best()

        def measure(part: slice) -> np.ndarray:
            given = chain, rows, self.x, known, whole, *self._gates(bits[part])
            return sums(*given) if device is None else batched.sums(device, *given)

        parts = _parts(len(bits), len(bits)) if device is None else [slice(None)]
        squared = np.concatenate(cores.run([partial(measure, part) for part in parts]))
        return squared, self._usable(bits).T.astype(np.float32) @ known

    def _arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the network is given of every row, which elements count (1 or 0), and which signals are whole."""
        rows = np.ascontiguousarray(np.concatenate([self.x, self.p], axis=1, dtype=np.float32))
        return rows, self.there.astype(np.float32), np.ascontiguousarray(self.whole)

    def _gates(self, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Elements that masks let through, shape (masks, size), and their signals, shape (masks, signals): 1 or 0."""
        return np.repeat(bits, self._sizes, axis=1).astype(np.float32), bits.astype(np.float32)

    def _usable(self, bits: np.ndarray) -> np.ndarray:
        """Which rows have all signals of a mask, shape (rows, masks)."""
        return np.asarray((~self.whole).astype(np.float32) @ bits.T.astype(np.float32) < 0.5)


def _parts(count: int, most: int) -> list[slice]:
    """So many masks cut into parts of at most `most`, and so that every core has one."""
    step = max(1, min(most, -(-count // cores.count())))
    return [slice(begin, begin + step) for begin in range(0, max(count, 1), step)]
