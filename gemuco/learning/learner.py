"""Training loop (paper, II-D): W and every p are learned together, each sample under a random mask that it allows.

The inputs of a whole pass over the data are prepared at once, so that a step computes only the network. The steps make
W swing around its best value; the held-out loss is that of its running mean, which is kept. Outliers are searched for
repeatedly during the training (`gemuco.learning.outliers`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gemuco.compiled.chain import pack, unpack
from gemuco.compiled.learning import EQUAL, SQUARED, gradients, loss
from gemuco.layers import Weights
from gemuco.learning import outliers
from gemuco.learning.config import TrainConfig
from gemuco.learning.draft import Draft
from gemuco.learning.material import Batch, Material
from gemuco.learning.soap import Soap
from gemuco.optimiser import Optimiser

Progress = Callable[[float, str], None]
"""This is called with the finished share, 0 to 1, and one line of text."""

HUBER = (0.3, 1.0)
"""Errors above this many standard deviations count linearly instead of squared, before and after the first search for
outliers. This limits the effect of outliers that are not detected yet. With 1 % of all values ten standard deviations
off, the error of the PR2's tip is 14 mm; with squared errors it is 141 mm, and on clean data 8 mm
(studies/accuracy/imperfect_data.py)."""

SEARCHES = 4, 16
"""Outliers are searched for at least and at most about this many times during a training, after the first quarter of
the epochs; in between as often as costs no more than the training itself."""

PASSES = 3
"""An epoch costs as much as this many predictions of all samples."""

DRAFTS = 40
"""A training is saved about this many times."""

MEAN = 0.98
"""Share of the past in the running mean of W and p."""

MOST_HELD = 4000
"""At most this many pairs of held-out sample and mask are measured after every epoch."""


def one_cycle(share: float) -> float:
    """Return the learning rate as a share of its peak: it rises during the first quarter of the steps, then falls."""
    if share < 0.25:
        return 0.04 + 0.96 * 0.5 * (1.0 - math.cos(math.pi * share / 0.25))
    return 1e-4 + 0.5 * (1.0 + math.cos(math.pi * (share - 0.25) / 0.75))


@dataclass(slots=True)
class Course:
    """Progress of a training.

    Attributes:
        train: Loss on the training data, one per epoch.
        held_out: Loss on the held-out data, one per epoch.
        least: Lowest held-out loss.
        best_epoch: Epoch of the lowest held-out loss; -1 if it was before the first epoch.
        best: W of this epoch in the layout of compiled code, and every p.
        resumed: Epoch at which an interrupted training was resumed.
    """

    train: list[float] = field(default_factory=list)
    held_out: list[float] = field(default_factory=list)
    least: float = math.inf
    best_epoch: int = -1
    best: dict[str, np.ndarray] = field(default_factory=dict)
    resumed: int = 0


class Learner:
    """Network, every p and the data during one training.

    Args:
        config: Settings.
        weights: Initial W.
        biases: Initial p of every condition, shape (conditions, bias_size).
        frozen: Whether the p of each condition stays as it is, shape (conditions,).
        material: Training samples.
        held: Held-out samples.

    Attributes:
        biases: Current p of every condition, shape (conditions, bias_size).
        chain: Current W.
        is_learned: Whether the p of each condition is learned, shape (conditions, 1).
        batch: Samples per step.
        epochs: Largest number of epochs.
        optimiser: Optimiser of W.
        bias_optimiser: Optimiser of every p.
        measurement: Held-out samples and the masks under which they are measured.
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
        self.is_learned = ~frozen[:, None]
        self.random = np.random.default_rng(config.seed)
        samples = int((material.usable < material.new).sum())
        self.batch, self.epochs = config.batch_for(samples), config.epochs_for(samples)
        self.optimiser = Soap(self.chain)
        self.bias_optimiser = Optimiser("adam", config.bias_rate, self.biases.size)
        self.measurement = self.held.every(MOST_HELD)
        self._mean = {name: numbers.copy() for name, numbers in self._numbers().items()}
        self.course = Course(best={name: numbers.copy() for name, numbers in self._numbers().items()})

    @property
    def weights(self) -> Weights:
        """Current W."""
        return self._start.replaced(unpack(self.chain))

    def run(self, progress: Progress | None, title: str, draft: Draft) -> Course:
        """Train until all epochs are done or the held-out loss stops falling; keep the best W and p."""
        if not self._restore(draft):
            self.course.least = self._held_out()
        while not self.is_done:
            self._epoch()
            if progress is not None:
                progress(self.epoch / self.epochs, f"{title}: held-out loss {self.course.least:.4f}")
            if self.epoch % max(1, self.epochs // DRAFTS) == 0 or self.epoch == self.epochs:
                draft.save(*self._state())
        for name, numbers in self._numbers().items():
            numbers[...] = self._mean[name][...] = self.course.best[name]
        self._reject_outliers()
        return self.course

    @property
    def epoch(self) -> int:
        """Number of finished epochs."""
        return len(self.course.train)

    @property
    def is_done(self) -> bool:
        """Whether all epochs are done, or the held-out loss has not fallen for `patience` epochs.

        While the loss is as large on the training data as on the held-out data, W only swings at a high learning rate.
        """
        if self.epoch >= self.epochs:
            return True
        course, patience = self.course, self.config.patience_for(self.epochs)
        has_stalled = self.epoch - max(course.best_epoch, 0) > patience
        return has_stalled and not course.train[-1] > course.held_out[-1]

    @property
    def _searches(self) -> range:
        """Epochs before which outliers are searched for."""
        least, most = SEARCHES
        affordable = PASSES * self.epochs // (outliers.JUDGES * len(self.task.x_out))
        begin = self.epochs // 4
        return range(begin, self.epochs, max(1, self.epochs // min(max(affordable, least), most)))

    def _epoch(self) -> None:
        """Learn from every sample once, and measure the loss on the held-out samples."""
        course, epoch, epochs = self.course, self.epoch, self.epochs
        searches = self._searches
        if epoch in searches:
            self._reject_outliers(spare_rare=epoch < epochs // 2)
        course.train.append(self._pass(epoch, HUBER[epoch > searches.start]))
        course.held_out.append(self._held_out())
        if course.held_out[-1] < course.least:
            course.least, course.best_epoch = course.held_out[-1], epoch
            course.best = {name: numbers.copy() for name, numbers in self._mean.items()}

    def _pass(self, epoch: int, bend: float) -> float:
        """Do all steps of an epoch and return their mean loss; see `HUBER` for `bend`."""
        rows, masks = self.material.draw(self.random, self.config.replay)
        batches = list(self.material.cut(self.material.take(rows, masks), self.batch))
        total = 0.0
        for index, batch in enumerate(batches):
            total += self._step(batch, one_cycle((epoch + index / len(batches)) / self.epochs), bend)
        return total / len(batches)

    def _step(self, batch: Batch, pace: float, bend: float) -> float:
        """Do one step and return the loss before it."""
        before, by_weights, by_input = gradients(
            self.chain, self._inputs(batch, self.biases), batch.target, EQUAL, self._bend(bend), True,
            self.biases.size > 0,
        )  # fmt: skip
        self.optimiser.move(self.chain.flat, by_weights, pace * self.config.rate)
        if self.biases.size:
            by_bias = np.zeros_like(self.biases)
            np.add.at(by_bias, batch.condition, by_input[:, -self.biases.shape[1] :])
            self.bias_optimiser.rate = pace * self.config.bias_rate
            self.bias_optimiser.move(self.biases.reshape(-1), (by_bias * self.is_learned).reshape(-1))
        for name, numbers in self._numbers().items():
            self._mean[name] += np.float32(1.0 - MEAN) * (numbers - self._mean[name])
        return float(before)

    def _inputs(self, batch: Batch, biases: np.ndarray) -> np.ndarray:
        if not biases.size:
            return batch.inputs
        return np.concatenate([batch.inputs, biases[batch.condition]], axis=1)

    def _bend(self, bend: float) -> np.float32:
        """Return where the loss changes from squared to linear; without outlier rejection it is squared everywhere."""
        return SQUARED if math.isinf(self.config.outliers) else np.float32(bend)

    def _held_out(self) -> float:
        rows, masks = self.measurement
        if not len(rows):
            return math.inf
        batch = self.held.take(rows, masks)
        chain = self.chain._replace(flat=self._mean["weights"])
        inputs = self._inputs(batch, self._mean["biases"])
        return float(loss(chain, inputs, batch.target, EQUAL, self._bend(HUBER[1])))

    def _reject_outliers(self, spare_rare: bool = False) -> None:
        """Search the training samples and the held-out samples for outliers.

        Args:
            spare_rare: Keep samples in which several signals are far out together: they may be of a rare motion that
                is not learned yet.
        """
        weights = self._start.replaced(unpack(self.chain._replace(flat=self._mean["weights"])))
        p, limit = self._mean["biases"], self.config.outliers
        for part in (self.material, self.held):
            suspects = outliers.find(part, weights, p[part.condition], limit)
            if spare_rare:
                suspects &= (part.far.sum(axis=1) < 2)[:, None]
            part.hide(suspects)
        self.measurement = self.held.every(MOST_HELD)

    def _numbers(self) -> dict[str, np.ndarray]:
        """Return the arrays of W and of every p."""
        return {"weights": self.chain.flat, "biases": self.biases}

    def _state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the arrays and facts that the next epoch depends on."""
        arrays = {f"now.{name}": numbers for name, numbers in self._numbers().items()}
        arrays |= {f"mean.{name}": numbers for name, numbers in self._mean.items()}
        arrays |= {f"best.{name}": numbers for name, numbers in self.course.best.items()}
        arrays |= {f"soap.weights.{name}": numbers for name, numbers in self.optimiser.state().items()}
        arrays |= {f"adam.biases.{name}": numbers for name, numbers in self.bias_optimiser.state().items()}
        arrays["suspected"], arrays["held_suspected"] = self.material.suspected, self.held.suspected
        facts = {
            "train": self.course.train,
            "held_out": self.course.held_out,
            "least": self.course.least,
            "best_epoch": self.course.best_epoch,
            "steps": self.optimiser.time,
            "random": self.random.bit_generator.state,
        }
        return arrays, facts

    def _restore(self, draft: Draft) -> bool:
        """Restore the state of an interrupted training from its draft; return whether there is one."""
        state = draft.load()
        if state is None:
            return False
        arrays, facts = state
        for name, numbers in self._numbers().items():
            numbers[...] = arrays[f"now.{name}"]
            self._mean[name][...] = arrays[f"mean.{name}"]
            self.course.best[name] = arrays[f"best.{name}"].copy()
        self.optimiser.time = self.bias_optimiser.time = facts["steps"]
        for kind, numbers in self.optimiser.state().items():
            numbers[...] = arrays[f"soap.weights.{kind}"]
        for kind, numbers in self.bias_optimiser.state().items():
            numbers[...] = arrays[f"adam.biases.{kind}"]
        self.material.hide(arrays["suspected"])
        self.held.hide(arrays["held_suspected"])
        self.measurement = self.held.every(MOST_HELD)
        self.random.bit_generator.state = facts["random"]
        self.course.train, self.course.held_out = facts["train"], facts["held_out"]
        self.course.least, self.course.best_epoch = facts["least"], facts["best_epoch"]
        self.course.resumed = len(facts["train"])
        return True
