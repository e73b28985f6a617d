"""The training loop (paper, II-D): W and every p together, each sample under a random feasible mask it allows.

Each pass over the data is made ready in bulk: masks are drawn, inputs gathered and masked for all samples at once, so
that a step is nothing but the network. Suspected outliers are looked for anew from time to time (`gemuco.outliers`).
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from gemuco import outliers
from gemuco.draft import Draft
from gemuco.material import Batch, Material
from gemuco.network import Network
from gemuco.train_config import TrainConfig

Progress = Callable[[float, str], None]
"""Called with the share that is done, 0 to 1, and one line of text."""

HUBER = (0.3, 1.0)
"""Misses above this many standard deviations count in proportion and no longer squared, before outliers were looked for
and after: what is not found out yet pulls at W like any large miss and not thirty times as hard. With 1 % of
all values ten standard deviations off the PR2's tip is wrong by 141 mm with the plain square and by 14 mm so (8 mm on
clean data; benchmarks/imperfect_data.py)."""

LOOKS = 16
"""How often outliers are looked for during a training, beginning when a quarter of it is done."""

DRAFTS = 40
"""How often a training is written down."""

MOST_HELD = 4000
"""Pairs of held-out sample and mask that are measured after every epoch, at most."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: on layers this small a second one only waits (256 samples: 1.7 ms against 42 ms)."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
        best: Its W and p.
        resumed: At which epoch it went on after an interruption.
    """

    train: list[float] = field(default_factory=list)
    held_out: list[float] = field(default_factory=list)
    best_epoch: int = 0
    best: dict[str, torch.Tensor] = field(default_factory=dict)
    resumed: int = 0


class Learner:
    """Network, every p, and the data, during one training.

    Args:
        config: How.
        network: Where W starts; it is changed.
        biases: Where every p starts, shape (conditions, bias_size).
        frozen: Which of them stay, shape (conditions,).
        material: What is learned from.
        held: What only measures.
    """

    def __init__(
        self,
        config: TrainConfig,
        network: Network,
        biases: np.ndarray,
        frozen: np.ndarray,
        material: Material,
        held: Material,
    ) -> None:
        self.config, self.network, self.material, self.held = config, network, material, held
        self.task = material.task
        self.biases = torch.nn.Parameter(torch.from_numpy(np.array(biases, np.float32)))
        if frozen.any():
            stays = torch.from_numpy((~frozen).astype(np.float32))[:, None]
            self.biases.register_hook(lambda gradient: gradient * stays)
        self.random = np.random.default_rng(config.seed)
        groups = [{"params": list(network.parameters()), "lr": config.rate, "peak": config.rate}]
        if self.biases.numel():
            groups.append({"params": [self.biases], "lr": config.bias_rate, "peak": config.bias_rate})
        self.optimiser = torch.optim.Adam(groups, fused=True)
        self.course = Course()
        self._measure = self.held.every(MOST_HELD)

    def run(self, progress: Progress | None, title: str, draft: Draft) -> Course:
        """Train to the end or until nothing gets better; leaves the best W and p in place."""
        config, course = self.config, self.course
        self._restore(draft)
        looks = range(config.epochs // 4, config.epochs, max(1, config.epochs // LOOKS))
        for epoch in range(len(course.train), config.epochs):
            if epoch - course.best_epoch > config.patience:
                break
            if epoch in looks:
                self._look(patient=epoch < config.epochs // 2)
            course.train.append(self._pass(epoch, HUBER[epoch > looks.start]))
            course.held_out.append(self._held_out())
            if epoch == 0 or course.held_out[-1] < course.held_out[course.best_epoch]:
                course.best_epoch, course.best = epoch, self._copy()
            if progress is not None:
                best = course.held_out[course.best_epoch]
                progress((epoch + 1) / config.epochs, f"{title}: held-out loss {best:.4f}")
            if (epoch + 1) % max(1, config.epochs // DRAFTS) == 0 or epoch + 1 == config.epochs:
                draft.save(*self._written())
        with torch.no_grad():
            for name, parameter in self._parameters().items():
                parameter.copy_(course.best[name])
        self._look()
        return course

    def _pass(self, epoch: int, straight: float) -> float:
        """One epoch; returns the mean loss of its steps."""
        rows, chosen = self.material.draw(self.random, self.config.replay)
        batches = list(self.material.cut(self.material.take(rows, chosen), self.config.batch))
        total = torch.zeros(())
        for index, batch in enumerate(batches):
            pace = one_cycle((epoch + index / len(batches)) / self.config.epochs)
            for group in self.optimiser.param_groups:
                group["lr"] = pace * group["peak"]
            self.optimiser.zero_grad(set_to_none=True)
            loss = self._loss(batch, straight)
            loss.backward()
            self.optimiser.step()
            total += loss.detach()
        return float(total) / len(batches)

    def _loss(self, batch: Batch, straight: float) -> torch.Tensor:
        """Mean squared miss over what was measured; in proportion beyond `straight` standard deviations."""
        inputs = batch.inputs
        if self.biases.numel():
            inputs = torch.cat([inputs, self.biases[batch.condition]], dim=1)
        told = self.network(inputs)
        count: float | torch.Tensor = float(told.numel())
        if batch.there is not None:
            told, count = told * batch.there, batch.there.sum().clamp(min=1.0)
        if math.isinf(self.config.outliers):
            return functional.mse_loss(told, batch.wanted, reduction="sum") / count
        return 2.0 * functional.huber_loss(told, batch.wanted, reduction="sum", delta=straight) / count

    @torch.no_grad()
    def _held_out(self) -> float:
        rows, chosen = self._measure
        return float(self._loss(self.held.take(rows, chosen), HUBER[1])) if len(rows) else math.inf

    def _look(self, patient: bool = False) -> None:
        """Suspect outliers anew, in what is learned and in what measures."""
        weights, p, limit = self.network.weights(), self.biases.detach().numpy(), self.config.outliers
        for part in (self.material, self.held):
            found = outliers.find(part, weights, p[part.condition], limit)
            if patient:  # several signals are far out together: perhaps a rare motion that is yet to be learned
                found &= (part.far.sum(axis=1) < 2)[:, None]
            part.hide(found)
        self._measure = self.held.every(MOST_HELD)

    def _parameters(self) -> dict[str, torch.nn.Parameter]:
        """W and every p, by name."""
        return {**dict(self.network.named_parameters()), "biases": self.biases}

    def _copy(self) -> dict[str, torch.Tensor]:
        return {name: parameter.detach().clone() for name, parameter in self._parameters().items()}

    def _written(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """All that the next epoch depends on: arrays and facts."""
        arrays = {f"now.{name}": tensor.numpy() for name, tensor in self._copy().items()}
        arrays |= {f"best.{name}": tensor.numpy() for name, tensor in self.course.best.items()}
        for name, parameter in self._parameters().items():
            for kind, tensor in self.optimiser.state[parameter].items():
                arrays[f"adam.{kind}.{name}"] = tensor.numpy()
        arrays["suspected"], arrays["held_suspected"] = self.material.suspected, self.held.suspected
        facts = {
            "train": self.course.train,
            "held_out": self.course.held_out,
            "best_epoch": self.course.best_epoch,
            "random": self.random.bit_generator.state,
        }
        return arrays, facts

    @torch.no_grad()
    def _restore(self, draft: Draft) -> None:
        """Go on where an interrupted training was written down, if it was."""
        found = draft.load()
        if found is None:
            return
        arrays, facts = found
        tensors = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
        for name, parameter in self._parameters().items():
            parameter.copy_(tensors[f"now.{name}"])
            kept = {kind: f"adam.{kind}.{name}" for kind in ("step", "exp_avg", "exp_avg_sq")}
            self.optimiser.state[parameter] = {k: tensors[n] for k, n in kept.items() if n in tensors}
            self.course.best[name] = tensors[f"best.{name}"]
        self.material.hide(arrays["suspected"])
        self.held.hide(arrays["held_suspected"])
        self._measure = self.held.every(MOST_HELD)
        self.random.bit_generator.state = facts["random"]
        self.course.train, self.course.held_out = facts["train"], facts["held_out"]
        self.course.best_epoch, self.course.resumed = facts["best_epoch"], len(facts["train"])
