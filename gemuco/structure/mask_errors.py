"""How badly one network infers every signal from any mask, measured on held-out rows."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gemuco.compiled.chain import pack
from gemuco.compiled.masks import Rows, squares
from gemuco.dataset import Dataset
from gemuco.layers import Chain
from gemuco.learning import batched, cores, devices, outliers
from gemuco.learning.material import Material
from gemuco.learning.task import Task
from gemuco.scaler import CLIP
from gemuco.schema import BodySchema
from gemuco.signals import Layout

RARE = 0.05
"""An outlier is rare: where more than this share of a signal would be, the model is wrong, and all counts."""


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
        usable = (~self.whole).astype(np.float32) @ bits.T.astype(np.float32) < 0.5  # (rows, masks)
        count = usable.T.astype(np.float32) @ self.there.astype(np.float32)
        measured = self.by_signal(np.where(count > 0, self.liveliness, 0.0))
        missed = self.by_signal(squared / np.maximum(count, 1))
        return np.where(measured > 0, missed / np.maximum(measured, 1e-12), np.nan)

    def sums(self, bits: np.ndarray) -> np.ndarray:
        """Sum of `squares` over all rows under every mask, on CUDA or this core, shape (masks, size)."""
        if (device := devices.best()) is not None:
            return batched.sums(device, pack(self.chain), self.given, *self.gates(bits))
        found = [one.sum(axis=0, dtype=float) for one in self.squares(bits)]
        return np.array(found).reshape(len(bits), self.layout.size)

    def squares(self, bits: np.ndarray) -> Iterator[np.ndarray]:
        """Squared errors of every row under every mask, 0 where they do not count, each of shape (rows, size)."""
        chain, rows = pack(self.chain), self.given
        for gate, mask in zip(*self.gates(bits), strict=True):
            yield squares(chain, rows, gate, mask)

    def from_others(self) -> tuple[np.ndarray, np.ndarray]:
        """Every signal from all others.

        Returns:
            Errors, shape (signals,), NaN if no row tells. And squared errors under the masks that lack one signal each,
            of every row and signal, shape (signals, rows, signals).
        """
        bits, total, by_row = ~np.eye(len(self.layout.names), dtype=bool), [], []
        for squared in self.squares(bits):
            total.append(squared.sum(axis=0, dtype=float))
            by_row.append(self.by_signal(squared))
        errors = self.of_sums(bits, np.stack(total)).diagonal().copy()
        for index in np.flatnonzero(np.isnan(errors)).tolist():
            errors[index] = self._from_some(index)
        return errors, np.stack(by_row)

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

    @property
    def given(self) -> Rows:
        """What compiled code is given of the rows."""
        rows = np.concatenate([self.x, self.p], axis=1, dtype=np.float32)
        return Rows(rows, self.x, self.there.astype(np.float32), np.ascontiguousarray(self.whole))

    def gates(self, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """And what of masks, shapes (masks, size) and (masks, signals)."""
        return np.repeat(bits, self.sizes, axis=1).astype(np.float32), bits.astype(np.float32)
