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
        return self.rows(np.linspace(0, len(self.x) - 1, rows).astype(int))

    def rows(self, chosen: np.ndarray) -> "MaskErrors":
        """On these rows (indices) and in this order."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in ("x", "there", "whole", "p")})

    def of(self, bits: np.ndarray) -> np.ndarray:
        """Errors under masks.

        Args:
            bits: One mask per line, shape (masks, signals), truth values.

        Returns:
            Share of the variance of every signal that every mask leaves unexplained, shape (masks, signals), NaN where
            no row tells.
        """
        parts = cores.parts(len(bits), len(bits)) if devices.best() is None else [slice(None)]
        squared = np.concatenate(cores.run([partial(self.sums, bits[part]) for part in parts]))
        return self.of_sums(bits, squared)

    def of_sums(self, bits: np.ndarray, squared: np.ndarray) -> np.ndarray:
        """The errors of `of` from `sums` over all rows, shape (masks, signals)."""
        count = self._usable(bits, slice(None)).T.astype(np.float32) @ self.there.astype(np.float32)
        measured = self.by_signal(np.where(count > 0, self.liveliness, 0.0))
        missed = self.by_signal(squared / np.maximum(count, 1))
        return np.where(measured > 0, missed / np.maximum(measured, 1e-12), np.nan)

    def sums(self, bits: np.ndarray, first: int = 0) -> np.ndarray:
        """Sum of `squares` over the rows from the first one on, on CUDA or this core, shape (masks, size)."""
        chain, given, device = pack(self.chain), self._given(bits, slice(first, None)), devices.best()
        return np.asarray(sums(chain, *given)) if device is None else batched.sums(device, chain, *given)

    def squares(self, bits: np.ndarray, span: slice, out: np.ndarray, lines: np.ndarray) -> None:
        """Squared errors of some rows under masks, 0 where they do not count, to these rows of `out` in these lines.

        Args:
            bits: Shape (masks, signals), truth values.
            span: The rows.
            out: Shape (lines, rows, size), float32.
            lines: Where each mask has its own, shape (masks,).
        """
        squares(pack(self.chain), out, lines, span.start or 0, *self._given(bits, span))

    def factors(self, bits: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """What makes weighted sums of `squares` errors.

        Args:
            bits: One mask per line, shape (masks, signals), truth values.
            weights: Of the first rows, of sum 1, shape (rows,).

        Returns:
            What to multiply the sum of an element's squares by, shape (masks, size): the sum over the elements of a
            signal is its error. NaN for a signal of which nothing living is measured, or that has a living element of
            which fewer than `TOLD` of the rows tell.
        """
        usable, there = self._usable(bits, slice(len(weights))).T, self.there[: len(weights)].astype(np.float32)
        count = usable.astype(np.float32) @ there
        # Not by BLAS, whose sums depend on how many masks there are: cores are to change nothing.
        share = np.einsum("mr,r,re->me", usable, weights, there)
        measured = self.by_signal(np.where(count > 0, self.liveliness, 0.0))
        is_scarce = (count < TOLD) | (2 * len(weights) * share < count)  # what hardly weighs tells little
        unclear = (self.by_signal(is_scarce & (self.liveliness > 0.0)) > 0) | (measured <= 0.0)
        whole = np.repeat(np.where(unclear, np.nan, measured), self.sizes, axis=1)
        return 1.0 / (np.where(is_scarce, 1.0, share) * whole)

    def from_others(self) -> tuple[np.ndarray, np.ndarray]:
        """Every signal from all others.

        Returns:
            Errors, shape (signals,), NaN if no row tells. And squared errors under the masks that lack one signal each,
            of every row and signal, shape (signals, rows, signals).
        """
        bits, squared = ~np.eye(len(self.layout.names), dtype=bool), np.empty((1, *self.x.shape), np.float32)
        total, by_row = (
            np.empty((len(bits), self.layout.size)),
            np.empty((len(bits), len(self.x), len(bits)), np.float32),
        )
        for index in range(len(bits)):
            self.squares(bits[index : index + 1], slice(None), squared, np.zeros(1, int))
            total[index], by_row[index] = squared[0].sum(axis=0, dtype=float), self.by_signal(squared[0])
        errors = self.of_sums(bits, total).diagonal().copy()
        for index in np.flatnonzero(np.isnan(errors)).tolist():
            errors[index] = self._from_some(index)
        return errors, by_row

    def _from_some(self, signal: int) -> float:
        """Error of a signal (by its index) that no row has together with all others; NaN if no row tells.

        Every row that has the signal is inferred from whatever others it has.
        """
        others = np.arange(len(self.layout.names)) != signal
        span = self.layout.slice(self.layout.names[signal])
        total, count = np.zeros(self.layout.size), np.zeros(self.layout.size)
        patterns, which = np.unique(self.whole & others, axis=0, return_inverse=True)
        for index in np.flatnonzero(patterns.any(axis=1)):
            part = self.rows(np.flatnonzero(which.ravel() == index))
            total += part.sums(patterns[index : index + 1])[0]
            count += part.there.sum(axis=0)
        known = self.liveliness[span] * (count[span] > 0)
        return float((total[span] / np.maximum(count[span], 1)).sum() / known.sum()) if known.any() else float("nan")

    @property
    def amounts(self) -> np.ndarray:
        """How much of each signal there is to explain, shape (signals,): its elements, if all vary."""
        return self.by_signal(self.liveliness)

    @property
    def sizes(self) -> list[int]:
        """How many elements each signal has."""
        return [signal.size for signal in self.layout.signals]

    def by_signal(self, elements: np.ndarray) -> np.ndarray:
        """Sums over the elements of every signal, shape (..., size) -> (..., signals)."""
        return np.asarray(np.add.reduceat(elements, np.cumsum([0, *self.sizes[:-1]]), axis=-1))

    def _given(self, bits: np.ndarray, span: slice) -> tuple[np.ndarray, ...]:
        """Of some rows and masks what compiled code is given after the network, see `gemuco.compiled.masks.sums`."""
        rows = np.concatenate([self.x[span], self.p[span]], axis=1, dtype=np.float32)
        known, whole = self.there[span].astype(np.float32), np.ascontiguousarray(self.whole[span])
        gates = np.repeat(bits, self.sizes, axis=1).astype(np.float32)
        return rows, self.x[span], known, whole, gates, bits.astype(np.float32)

    def _usable(self, bits: np.ndarray, span: slice) -> np.ndarray:
        """Which rows of some have all signals of a mask, shape (rows, masks)."""
        return np.asarray((~self.whole[span]).astype(np.float32) @ bits.T.astype(np.float32) < 0.5)
