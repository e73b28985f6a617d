"""Errors of a network that infers every signal from any mask, measured on held-out rows."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from gemuco.compiled.blas import cores, one_thread
from gemuco.compiled.chain import pack
from gemuco.compiled.masks import Rows, squared_errors
from gemuco.dataset import Dataset
from gemuco.layers import Chain
from gemuco.learning import outliers
from gemuco.learning.material import Material
from gemuco.learning.task import Task
from gemuco.linear import LinearPath
from gemuco.scaler import CLIP
from gemuco.schema import BodySchema
from gemuco.signals import Layout

RARE = 0.05
"""If a larger share of a signal's samples are suspected outliers, the model is wrong and all its samples count."""
STRIPES = 20
"""Held-out rows are halved by this many stripes of neighbouring rows."""
LISTED = 10
"""With at most this many signals every mask is measured."""


@dataclass(frozen=True, slots=True, eq=False)
class MaskErrors:
    """A network that infers every signal from any mask, and the rows on which it is measured.

    Errors are shares of variance: the error of always guessing the mean is 1. For elements that vary, this is the mean
    squared error in standard deviations. An element that hardly moves (below the floor of its signal's scale) counts
    less, and an element that never moves does not count; otherwise dead channels would make a signal look well
    inferred.

    Attributes:
        layout: The signals.
        chain: The network. Inputs: all signals, the code of the linear path, one bit per signal, and p. Outputs: all
            signals.
        path: The linear path.
        x: Held-out rows [standard deviations], clipped, gaps filled by zero, shape (rows, size).
        counts: Whether an element is measured and not dead, shape (rows, size).
        whole: Whether a signal is complete, shape (rows, signals).
        p: Parametric bias of every row, shape (rows, bias_size).
        liveliness: Variance of every element in the training data, at most 1 [standard deviations squared], (size,).
        scale: Standard deviation of every element in the training data [unit], shape (size,).
    """

    layout: Layout
    chain: Chain
    path: LinearPath
    x: np.ndarray
    counts: np.ndarray
    whole: np.ndarray
    p: np.ndarray
    liveliness: np.ndarray
    scale: np.ndarray

    @classmethod
    def of_schema(cls, schema: BodySchema, train: Dataset, held: Dataset, limit: float) -> "MaskErrors":
        """Measure a schema, whose inputs and outputs are all signals, on held-out samples.

        Each sample is measured under the p of its condition. Outliers (`TrainConfig.outliers`) do not count.
        """
        layout, scaler = schema.layout, schema.scaler
        x = scaler.normalise(held.rows())
        p = np.zeros((len(x), len(schema.bias)), np.float32)
        if len(schema.bias):
            p = np.stack([schema.biases[c] for c in held.conditions])[held.condition_of_rows()]
        task = Task(layout, schema.masks, schema.x_out, schema.linear)
        material = Material(task, x, held.condition_of_rows(), scaler)
        wild = outliers.find(material, schema.weights, p, limit)
        wild[:, wild.mean(axis=0) > RARE] = False
        counts = np.isfinite(x) & ~wild[:, task.signal_of]
        granted = counts.copy()
        granted[:, scaler.dead] = True  # a mask does not need dead elements
        counts[:, scaler.dead] = False
        whole = np.stack([granted[:, layout.slice(name)].all(axis=1) for name in layout.names], axis=1)
        known = scaler.normalise(train.rows())
        liveliness = np.zeros(layout.size)
        for element in np.setdiff1d(np.arange(layout.size), scaler.dead):
            liveliness[element] = min(1.0, float(np.nanvar(known[:, element])))
        x = np.clip(np.where(counts, x, 0.0), -CLIP, CLIP).astype(np.float32)
        return cls(layout, schema.weights.whole, schema.path, x, counts, whole, p, liveliness, scaler.std)

    def thinned(self, most: int) -> "MaskErrors":
        """Return a copy with at most `most` rows, evenly selected."""
        if len(self.x) <= most:
            return self
        return self.rows(np.linspace(0, len(self.x) - 1, most).astype(int))

    def rows(self, index: np.ndarray) -> "MaskErrors":
        """Return a copy with the rows of these indices, in this order."""
        return replace(self, **{name: getattr(self, name)[index] for name in ("x", "counts", "whole", "p")})

    def halves(self) -> tuple["MaskErrors", "MaskErrors"]:
        """Return two halves of the rows: every other one of `STRIPES` stripes of neighbouring rows."""
        stripes = np.array_split(np.arange(len(self.x)), STRIPES)
        return self.rows(np.concatenate(stripes[0::2])), self.rows(np.concatenate(stripes[1::2]))

    def of(self, masks: np.ndarray) -> np.ndarray:
        """Measure masks on all cores.

        Args:
            masks: Truth values, shape (masks, signals).

        Returns:
            Share of the variance of every signal that each mask leaves unexplained, shape (masks, signals), NaN where
            no row has all signals of the mask.
        """
        mean, is_known = self._mean_squares(masks)
        variance = self.by_signal(np.where(is_known, self.liveliness, 0.0))
        return np.where(variance > 0, self.by_signal(mean) / np.maximum(variance, 1e-12), np.nan)

    def in_units(self, masks: np.ndarray) -> np.ndarray:
        """Return the mean square error over the live elements of every signal [unit squared], shape (masks, signals).

        It is NaN where no row has all signals of the mask.
        """
        mean, is_known = self._mean_squares(masks)
        counted = is_known & (self.liveliness > 0.0)
        amounts = self.by_signal(counted.astype(float))
        total = self.by_signal(np.where(counted, mean * self.scale**2, 0.0))
        return np.where(amounts > 0, total / np.maximum(amounts, 1.0), np.nan)

    def _mean_squares(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean squared error of every element [standard deviations squared], and whether it is known."""
        usable = (~self.whole).astype(np.float32) @ masks.T.astype(np.float32) < 0.5  # (rows, masks)
        count = usable.T.astype(np.float32) @ self.counts.astype(np.float32)
        return self.squared(masks) / np.maximum(count, 1), count > 0

    def squared(self, masks: np.ndarray) -> np.ndarray:
        """Return the sum of squared errors of every element over the rows that count, shape (masks, size).

        Each core measures a part of the masks; compiled code holds no interpreter lock.
        """
        chain, count = pack(self.chain), min(cores(), len(masks))
        inputs = np.concatenate([self.x, self.p], axis=1, dtype=np.float32)
        rows = Rows(inputs, self.x, self.counts.astype(np.float32), np.ascontiguousarray(self.whole))

        def part(share: np.ndarray) -> np.ndarray:
            gates = np.repeat(share, self.sizes, axis=1).astype(np.float32)
            paths = np.stack([self.path.map(gate) for gate in gates])
            return np.asarray(squared_errors(chain, rows, gates, paths, share.astype(np.float32)))

        with one_thread(), ThreadPoolExecutor(max(1, count)) as pool:
            return np.concatenate(list(pool.map(part, np.array_split(masks, count))))

    def from_others(self) -> np.ndarray:
        """Return the error of every signal inferred from all others, shape (signals,); NaN if no row allows it."""
        errors = self.of(~np.eye(len(self.layout.names), dtype=bool)).diagonal().copy()
        for index in np.flatnonzero(np.isnan(errors)).tolist():
            errors[index] = self._from_some(index)
        return errors

    def _from_some(self, signal: int) -> float:
        """Return the error of a signal (by its index) that no row contains together with all others.

        In every row the signal is inferred from the others that are present. The error is NaN if no row has the signal.
        """
        others = np.arange(len(self.layout.names)) != signal
        span = self.layout.slice(self.layout.names[signal])
        total, count = np.zeros(self.layout.size), np.zeros(self.layout.size)
        patterns, which = np.unique(self.whole & others, axis=0, return_inverse=True)
        for index in np.flatnonzero(patterns.any(axis=1)):
            part = self.rows(np.flatnonzero(which.ravel() == index))
            total += part.squared(patterns[index : index + 1])[0]
            count += part.counts.sum(axis=0)
        known = self.liveliness[span] * (count[span] > 0)
        return float((total[span] / np.maximum(count[span], 1)).sum() / known.sum()) if known.any() else float("nan")

    @property
    def amounts(self) -> np.ndarray:
        """Variance of each signal, shape (signals,): the number of its elements if all vary."""
        return self.by_signal(self.liveliness)

    @property
    def sizes(self) -> list[int]:
        """Number of elements of each signal."""
        return [signal.size for signal in self.layout.signals]

    def by_signal(self, elements: np.ndarray) -> np.ndarray:
        """Return the sums over the elements of every signal, shape (..., size) -> (..., signals)."""
        return np.asarray(np.add.reduceat(elements, np.cumsum([0, *self.sizes[:-1]]), axis=-1))
