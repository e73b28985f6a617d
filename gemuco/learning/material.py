"""Samples made ready for the network: normalised, gaps filled and remembered, masks drawn for a whole pass at once."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gemuco.learning.task import Task
from gemuco.scaler import CLIP, Scaler


class Batch(NamedTuple):
    """What one step learns from, a row per sample.

    Attributes:
        inputs: x_in under its mask, and m, shape (n, in_size + signals of x_in).
        condition: Whose p goes with it, shape (n,).
        wanted: x_out, NaN where it was not measured, shape (n, out_size).
    """

    inputs: np.ndarray
    condition: np.ndarray
    wanted: np.ndarray


class Material:
    """Samples with what is known to be missing from them.

    Args:
        task: Masks and signals.
        rows: Samples [standard deviations], shape (samples, layout.size), NaN where nothing was measured.
        condition: Whose p goes with every sample, shape (samples,).
        scaler: What is usual, and which elements are dead. What is stuck or silent for ever says nothing, so its
            absence hinders nothing: a mask needs only the living elements of its signals.
        new: Samples from this one on are old ones, replayed lest they be forgotten; all are new if not given.
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
        self._x_in = np.clip(filled[:, task.in_index], -CLIP, CLIP).astype(np.float32)
        self._x_out = filled[:, task.out_index].astype(np.float32)
        self.hide(np.zeros((len(rows), len(task.layout.names)), bool))

    def hide(self, suspected: np.ndarray) -> None:
        """Treat some signals as not measured, shape (samples, signals)."""
        self.suspected = suspected
        hidden = suspected[:, self.task.signal_of]
        there = (self._measured & ~hidden)[:, self.task.out_index]
        self._wanted = np.where(there, self._x_out, np.float32(np.nan))
        self.allowed = self.task.allowed(self.granted & ~hidden)
        self.usable = np.flatnonzero(self.allowed.any(axis=1) & there.any(axis=1))

    @property
    def skipped(self) -> int:
        """New samples that no mask fits, or with nothing to learn from."""
        return self.new - int((self.usable < self.new).sum())

    def draw(self, random: np.random.Generator, replay: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """One pass: every usable sample once, in random order, each under a random mask it allows: (rows, masks).

        Args:
            random: Source of chance.
            replay: As many of the old samples as this times the new ones.
        """
        new, old = self.usable[self.usable < self.new], self.usable[self.usable >= self.new]
        count = min(len(old), round(replay * len(new)))
        rows = random.permutation(np.concatenate([new, random.permutation(old)[:count]]))
        chosen = random.integers(0, len(self.task.masks), len(rows))
        wrong = np.flatnonzero(~self.allowed[rows, chosen])
        if len(wrong):
            dice = random.random((len(wrong), len(self.task.masks)), np.float32)
            chosen[wrong] = np.where(self.allowed[rows[wrong]], dice, -1.0).argmax(axis=1)
        return rows, chosen

    def every(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Samples with every mask they allow, evenly thinned to `most` pairs: (rows, masks)."""
        rows, chosen = np.nonzero(self.allowed[self.usable])
        kept = np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)
        return self.usable[rows[kept]], chosen[kept]

    def take(self, rows: np.ndarray, chosen: np.ndarray) -> Batch:
        """Samples under masks, ready for the network."""
        inputs = np.concatenate([self._x_in[rows] * self.task.through[chosen], self.task.tails[chosen]], axis=1)
        return Batch(inputs, self.condition[rows], self._wanted[rows])

    @staticmethod
    def cut(batch: Batch, size: int) -> Iterator[Batch]:
        """A long batch in pieces."""
        for start in range(0, len(batch.inputs), size):
            yield Batch(*(part[start : start + size] for part in batch))
