"""The training loop (paper, II-D): W and every p together, each sample under a random feasible mask it allows.

Each pass over the data is made ready in bulk: masks are drawn, inputs gathered and masked for all samples at once, so
that a step is nothing but the network. Suspected outliers are looked for anew from time to time
(`gemuco.learning.outliers`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gemuco.compiled.chain import pack, unpack
from gemuco.compiled.learning import SQUARED, gradients, loss
from gemuco.layers import Weights
from gemuco.learning import outliers
from gemuco.learning.config import TrainConfig
from gemuco.learning.draft import Draft
from gemuco.learning.material import Batch, Material
from gemuco.optimiser import Optimiser

Progress = Callable[[float, str], None]
"""Called with the share that is done, 0 to 1, and one line of text."""

HUBER = (0.3, 1.0)
"""Misses above this many standard deviations count in proportion and no longer squared, before outliers were looked for
and after: what is not found out yet pulls at W like any large miss and not thirty times as hard. With 1 % of
all values ten standard deviations off the PR2's tip is wrong by 141 mm with the plain square and by 14 mm so (8 mm on
clean data; studies/accuracy/imperfect_data.py)."""

LOOKS = 16
"""How often outliers are looked for during a training, beginning when a quarter of it is done."""

DRAFTS = 40
"""How often a training is written down."""

MOST_HELD = 4000
"""Pairs of held-out sample and mask that are measured after every epoch, at most."""


def one_cycle(share: float) -> float:
    """Learning rate as a share of its peak when a share of the steps is done: up for a quarter, then down."""
    if share < 0.25:
        return 0.04 + 0.96 * 0.5 * (1.0 - math.cos(math.pi * share / 0.25))
    return 1e-4 + 0.5 * (1.0 + math.cos(math.pi * (share - 0.25) / 0.75))


@dataclass(slots=True)
class Course:
    """How far a training is.

    Attributes:
        train: Loss while learning, one per epoch.
        held_out: Held-out loss, one per epoch.
        best_epoch: Epoch of the best held-out loss.
        best: Its W, as compiled code has it, and p.
        resumed: At which epoch it went on after an interruption.
    """

    train: list[float] = field(default_factory=list)
    held_out: list[float] = field(default_factory=list)
    best_epoch: int = 0
    best: dict[str, np.ndarray] = field(default_factory=dict)
    resumed: int = 0

    @property
    def least(self) -> float:
        """The best held-out loss."""
        return self.held_out[self.best_epoch]


class Learner:
    """Network, every p, and the data, during one training.

    Args:
        config: How.
        weights: Where W starts.
        biases: Where every p starts, shape (conditions, bias_size).
        frozen: Which of them stay, shape (conditions,).
        material: What is learned from.
        held: What only measures.

    Attributes:
        biases: Every p as it is now, shape (conditions, bias_size).
        chain: W as it is now.
        moves: Which p are learned, shape (conditions, 1).
        optimiser: What moves W.
        bias_optimiser: What moves p.
        measure: Held-out samples and the masks they are measured under.
    """

    def __init__(
        self,
        config: TrainConfig,
        weights: Weights,
        biases: np.ndarray,
        frozen: np.ndarray,
        material: Material,
        held: Material,
    ) -> None:
        self.config, self.material, self.held = config, material, held
        self.task = material.task
        self.biases = np.array(biases, np.float32)
        self._start, self.chain = weights, pack(weights.whole)
        self.moves = ~frozen[:, None]
        self.random = np.random.default_rng(config.seed)
        self.optimiser = Optimiser("adam", config.rate, len(self.chain.flat))
        self.bias_optimiser = Optimiser("adam", config.bias_rate, self.biases.size)
        self.course = Course()
        self.measure = self.held.every(MOST_HELD)

    @property
    def weights(self) -> Weights:
        """W as it is now."""
        return self._start.replaced(unpack(self.chain))

    def run(self, progress: Progress | None, title: str, draft: Draft) -> Course:
        """Train to the end or until nothing gets better; leaves the best W and p in place."""
        self._restore(draft)
        while not self.is_done:
            self._epoch()
            if progress is not None:
                progress(self.epoch / self.config.epochs, f"{title}: held-out loss {self.course.least:.4f}")
            if self.epoch % max(1, self.config.epochs // DRAFTS) == 0 or self.epoch == self.config.epochs:
                draft.save(*self._written())
        for name, numbers in self._numbers().items():
            numbers[...] = self.course.best[name]
        self._look()
        return self.course

    @property
    def epoch(self) -> int:
        """How many are done."""
        return len(self.course.train)

    @property
    def is_done(self) -> bool:
        """Whether all epochs are done, or nothing got better for long."""
        return self.epoch >= self.config.epochs or self.epoch - self.course.best_epoch > self.config.patience

    def _epoch(self) -> None:
        """Learn from every sample once, and measure on what is held out."""
        course, epoch, epochs = self.course, self.epoch, self.config.epochs
        looks = range(epochs // 4, epochs, max(1, epochs // LOOKS))
        if epoch in looks:
            self._look(patient=epoch < epochs // 2)
        course.train.append(self._pass(epoch, HUBER[epoch > looks.start]))
        course.held_out.append(self._held_out())
        if epoch == 0 or course.held_out[-1] < course.least:
            course.best_epoch, course.best = epoch, self._copy()

    def _pass(self, epoch: int, straight: float) -> float:
        """One epoch; returns the mean loss of its steps."""
        rows, chosen = self.material.draw(self.random, self.config.replay)
        batches = list(self.material.cut(self.material.take(rows, chosen), self.config.batch))
        total = 0.0
        for index, batch in enumerate(batches):
            total += self._step(batch, one_cycle((epoch + index / len(batches)) / self.config.epochs), straight)
        return total / len(batches)

    def _step(self, batch: Batch, pace: float, straight: float) -> float:
        """One step of Adam; returns the loss before it."""
        missed, by_weights, by_input = gradients(
            self.chain, self._inputs(batch), batch.wanted, self._straight(straight), True, self.biases.size > 0
        )
        self.optimiser.rate = pace * self.config.rate
        self.optimiser.move(self.chain.flat, by_weights)
        if self.biases.size:
            by_bias = np.zeros_like(self.biases)
            np.add.at(by_bias, batch.condition, by_input[:, -self.biases.shape[1] :])
            self.bias_optimiser.rate = pace * self.config.bias_rate
            self.bias_optimiser.move(self.biases.reshape(-1), (by_bias * self.moves).reshape(-1))
        return float(missed)

    def _inputs(self, batch: Batch) -> np.ndarray:
        return (
            np.concatenate([batch.inputs, self.biases[batch.condition]], axis=1) if self.biases.size else batch.inputs
        )

    def _straight(self, usual: float) -> np.float32:
        """Misses above this many standard deviations count in proportion; none, where nothing is rejected either."""
        return SQUARED if math.isinf(self.config.outliers) else np.float32(usual)

    def _held_out(self) -> float:
        rows, chosen = self.measure
        if not len(rows):
            return math.inf
        batch = self.held.take(rows, chosen)
        return float(loss(self.chain, self._inputs(batch), batch.wanted, self._straight(HUBER[1])))

    def _look(self, patient: bool = False) -> None:
        """Suspect outliers anew, in what is learned and in what measures."""
        weights, p, limit = self.weights, self.biases, self.config.outliers
        for part in (self.material, self.held):
            found = outliers.find(part, weights, p[part.condition], limit)
            if patient:  # several signals are far out together: perhaps a rare motion that is yet to be learned
                found &= (part.far.sum(axis=1) < 2)[:, None]
            part.hide(found)
        self.measure = self.held.every(MOST_HELD)

    def _numbers(self) -> dict[str, np.ndarray]:
        """W and every p."""
        return {"weights": self.chain.flat, "biases": self.biases}

    def _copy(self) -> dict[str, np.ndarray]:
        return {name: numbers.copy() for name, numbers in self._numbers().items()}

    def _written(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """All that the next epoch depends on: arrays and facts."""
        arrays = {f"now.{name}": numbers for name, numbers in self._numbers().items()}
        arrays |= {f"best.{name}": numbers for name, numbers in self.course.best.items()}
        arrays |= {f"adam.weights.{name}": numbers for name, numbers in self.optimiser.state().items()}
        arrays |= {f"adam.biases.{name}": numbers for name, numbers in self.bias_optimiser.state().items()}
        arrays["suspected"], arrays["held_suspected"] = self.material.suspected, self.held.suspected
        facts = {
            "train": self.course.train,
            "held_out": self.course.held_out,
            "best_epoch": self.course.best_epoch,
            "steps": self.optimiser.time,
            "random": self.random.bit_generator.state,
        }
        return arrays, facts

    def _restore(self, draft: Draft) -> None:
        """Go on where an interrupted training was written down, if it was."""
        found = draft.load()
        if found is None:
            return
        arrays, facts = found
        for name, numbers in self._numbers().items():
            numbers[...] = arrays[f"now.{name}"]
            self.course.best[name] = arrays[f"best.{name}"].copy()
        for name, optimiser in (("weights", self.optimiser), ("biases", self.bias_optimiser)):
            for kind, numbers in optimiser.state().items():
                numbers[...] = arrays[f"adam.{name}.{kind}"]
            optimiser.time = facts["steps"]
        self.material.hide(arrays["suspected"])
        self.held.hide(arrays["held_suspected"])
        self.measure = self.held.every(MOST_HELD)
        self.random.bit_generator.state = facts["random"]
        self.course.train, self.course.held_out = facts["train"], facts["held_out"]
        self.course.best_epoch, self.course.resumed = facts["best_epoch"], len(facts["train"])
