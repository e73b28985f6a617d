"""Samples prepared for the network: normalised, with gaps filled, and with a mask drawn for each."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gemuco.learning.task import Task
from gemuco.scaler import CLIP, Scaler


class Batch(NamedTuple):
    """Samples of one step.

    Attributes:
        inputs: x_in under the mask of each sample, the code l and m, shape (n, in_size + width + signals of x_in).
        condition: Index of the condition whose p belongs to each sample, shape (n,).
        target: x_out, NaN where not measured, shape (n, out_size).
    """

    inputs: np.ndarray
    condition: np.ndarray
    target: np.ndarray


class Material:
    """Samples, their missing elements and their outliers.

    Args:
        task: Masks and signals.
        rows: Samples [standard deviations], shape (samples, layout.size), NaN where not measured.
        condition: Index of the condition whose p belongs to each sample, shape (samples,).
        scaler: Range of every element, and the dead elements. A mask does not need the dead elements of its signals.
        new: Number of new samples; the samples behind them are old ones that are replayed. All are new if not given.

    Attributes:
        far: Whether a signal has an element far outside its usual range, shape (samples, signals).
        granted: Whether an element is measured or not needed, shape (samples, layout.size).
        suspected: Signals that are treated as not measured, shape (samples, signals).
        allowed: Masks that each sample allows, shape (samples, masks).
        usable: Indices of samples with an allowed mask and a measured output, shape (usable,).
    """

    def __init__(
        self, task: Task, rows: np.ndarray, condition: np.ndarray, scaler: Scaler, new: int | None = None
    ) -> None:
        self.task, self.rows, self.condition = task, rows, condition
        dead = scaler.dead
        outside = (rows < scaler.normalise(scaler.low) - 1e-6) | (rows > scaler.normalise(scaler.high) + 1e-6)
        outside[:, dead] = False
        self.far = task.any_of(outside)
        self.new = len(rows) if new is None else new
        self._measured = np.isfinite(rows)
        self.granted = self._measured.copy()
        self._measured[:, dead] = False
        alive = np.delete(task.signal_of, dead)
        self.granted[:, dead[np.isin(task.signal_of[dead], alive)]] = True
        filled = np.where(self._measured, rows, 0.0)
        self._x_in = filled[:, task.in_index].astype(np.float32)
        self._x_out = filled[:, task.out_index].astype(np.float32)
        self.hide(np.zeros((len(rows), len(task.layout.names)), bool))

    def hide(self, suspected: np.ndarray) -> None:
        """Treat suspected signals, shape (samples, signals), as not measured."""
        self.suspected = suspected
        hidden = suspected[:, self.task.signal_of]
        is_target = (self._measured & ~hidden)[:, self.task.out_index]
        self._target = np.where(is_target, self._x_out, np.float32(np.nan))
        self.allowed = self.task.allowed(self.granted & ~hidden)
        self.usable = np.flatnonzero(self.allowed.any(axis=1) & is_target.any(axis=1))

    @property
    def skipped(self) -> int:
        """Number of new samples without an allowed mask or without a measured output."""
        return self.new - int((self.usable < self.new).sum())

    def draw(self, random: np.random.Generator, replay: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Draw one pass over the data: every usable new sample once, in random order, under a random allowed mask.

        Args:
            random: Source of chance.
            replay: Number of old samples per new sample.

        Returns:
            Indices of the samples and of their masks, shape (n,).
        """
        new, old = self.usable[self.usable < self.new], self.usable[self.usable >= self.new]
        count = min(len(old), round(replay * len(new)))
        rows = random.permutation(np.concatenate([new, random.permutation(old)[:count]]))
        masks = random.integers(0, len(self.task.masks), len(rows))
        wrong = np.flatnonzero(~self.allowed[rows, masks])
        if len(wrong):
            dice = random.random((len(wrong), len(self.task.masks)), np.float32)
            masks[wrong] = np.where(self.allowed[rows[wrong]], dice, -1.0).argmax(axis=1)
        return rows, masks

    def every(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of samples and masks of all allowed pairs, evenly thinned to at most `most` pairs."""
        rows, masks = np.nonzero(self.allowed[self.usable])
        thinned = np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)
        return self.usable[rows[thinned]], masks[thinned]

    def take(self, rows: np.ndarray, masks: np.ndarray) -> Batch:
        """Return samples under masks, both by index, as the network needs them."""
        task = self.task
        x = self._x_in[rows] * task.through[masks]
        code = np.empty((len(rows), task.paths.shape[2]), np.float32)
        if code.shape[1]:
            order = np.argsort(masks, kind="stable")
            for part in np.split(order, np.flatnonzero(np.diff(masks[order])) + 1):
                path = task.paths[masks[part[0]]] if len(part) else task.paths[0]
                code[part] = x[part] @ path[:-1] + path[-1]
        inputs = np.concatenate([np.clip(x, -CLIP, CLIP), code, task.tails[masks]], axis=1)
        return Batch(inputs, self.condition[rows], self._target[rows])

    @staticmethod
    def cut(batch: Batch, size: int) -> Iterator[Batch]:
        """Yield a batch in parts of at most `size` samples."""
        for start in range(0, len(batch.inputs), size):
            yield Batch(*(part[start : start + size] for part in batch))
