"""Several trainings at once: on all cores, or where there is CUDA as one stack of networks; and many masks on CUDA.

Each member of a stack draws what it learns from exactly as on its own (`Learner`, `Material`): the same batches,
masks, looks for outliers, and stops. What is done together is the network: a product of the stack is one call, and so
is a step of Adam on the stack of all W. After every epoch W, p and what Adam remembers go back into the learners, so
that a training that was interrupted goes on with or without CUDA.
"""

from collections.abc import Sequence
from functools import partial
from threading import Event, Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from gemuco.compiled.bend import CODES
from gemuco.compiled.chain import CODE, NARROW, PLACE, WIDE, Packed
from gemuco.compiled.learning import MOMENTUM, SQUARES
from gemuco.compiled.masks import Rows
from gemuco.layers import LINEAR
from gemuco.learning import cores, devices
from gemuco.learning.draft import Draft
from gemuco.learning.learner import HUBER, Learner, Progress, one_cycle
from gemuco.learning.material import Batch

if TYPE_CHECKING:
    import torch

TOGETHER = 1_000_000
"""So many pairs of a mask and a row are measured in one go, about: some hundred values each are held."""
NAMES = {code: name for name, code in CODES.items()}


def train(
    learners: Sequence[Learner],
    drafts: Sequence[Draft],
    progress: Progress | None,
    title: str,
    device: str | None = None,
) -> None:
    """Train each to its end.

    Args:
        learners: Those whose networks have one shape are stacked.
        drafts: Where each is kept.
        progress: Told the share done of all of them.
        title: Begins the progress text.
        device: Of torch, to train stacks on; the best there is if not given, and if there is none, compiled code.
    """
    device = device or devices.best()
    if device is None:
        _train_side_by_side(learners, drafts, progress, title)
        return
    for learner, draft in zip(learners, drafts, strict=True):
        learner.restore(draft)
    while running := [index for index, learner in enumerate(learners) if not learner.is_done]:
        first = _shape(learners[running[0]])
        together = [index for index in running if _shape(learners[index]) == first]
        stack = [learners[index] for index in together]
        losses, held_out = _epoch(stack, device)
        for index, loss, held in zip(together, losses, held_out, strict=True):
            learners[index].end(loss, held)
        if progress is not None:
            shares = [1.0 if one.is_done else one.epoch / one.config.epochs for one in learners]
            least = float(np.mean([one.course.least for one in stack]))
            progress(float(np.mean(shares)), f"{title}: held-out loss {least:.4f}")
        for index in together:
            learners[index].keep(drafts[index])
    for learner in learners:
        learner.close()


class Stopped(Exception):
    """Another training failed, or whoever waits was interrupted."""


def _train_side_by_side(
    learners: Sequence[Learner], drafts: Sequence[Draft], progress: Progress | None, title: str
) -> None:
    """Train each in compiled code, as many at a time as there are cores; one that fails ends the others soon."""
    if len(learners) == 1:
        learners[0].run(progress, title, drafts[0])
        return
    done, stop, telling = np.zeros(len(learners)), Event(), Lock()

    def follow(index: int) -> Progress:
        def tell(share: float, text: str) -> None:
            if stop.is_set():
                raise Stopped
            with telling:
                done[index] = share
                if progress is not None:
                    progress(float(done.mean()), text)

        return tell

    def job(index: int) -> None:
        learners[index].run(follow(index), title, drafts[index])
        follow(index)(1.0, f"{title}: held-out loss {learners[index].course.least:.4f}")

    cores.run([partial(job, index) for index in range(len(learners))], stop)


def _shape(learner: Learner) -> tuple[Any, ...]:
    return learner.chain.form.tobytes(), learner.biases.shape, learner.config.batch


def _epoch(stack: Sequence[Learner], device: str) -> tuple[list[float], list[float]]:
    """One pass of every member over its data; their losses while learning and held-out ones."""
    import torch

    usual = [learner.begin() for learner in stack]
    numbers = _Numbers(stack, device)
    batches, steps = _cut(stack)
    inputs, condition, wanted = (torch.from_numpy(part).to(device) for part in batches)
    paces = torch.from_numpy(_paces(stack, steps)).to(device)
    straight = _straight(stack, usual, device)
    total = torch.zeros(len(stack), device=device)
    for step in range(int(steps.max())):
        loss = numbers.loss(inputs[step], condition[step], wanted[step], straight)
        numbers.move(loss, paces[step])
        total += loss.detach()
    numbers.bring_back(steps)
    with torch.no_grad():
        held_out = _held_out(stack, numbers, device)
    return (total.cpu().numpy() / steps).astype(float).tolist(), held_out


def _cut(stack: Sequence[Learner]) -> tuple[Batch, np.ndarray]:
    """Batches of every member, each of shape (steps, members, batch, n), and how many each has, shape (members,).

    What is short is filled up with rows of which nothing is wanted: they add nothing to a loss.
    """
    drawn = []
    for learner in stack:
        rows, chosen = learner.material.draw(learner.random, learner.config.replay)
        drawn.append(learner.material.take(rows, chosen))
    size = stack[0].config.batch
    steps = np.array([-(-len(one.inputs) // size) for one in drawn])
    whole = _side_by_side(drawn, int(steps.max()) * size)
    count, members = int(steps.max()), len(stack)
    parts = (part.reshape(members, count, size, *part.shape[2:]).swapaxes(0, 1) for part in whole)
    return Batch(*(np.ascontiguousarray(part) for part in parts)), steps


def _side_by_side(drawn: Sequence[Batch], rows: int) -> Batch:
    """Batches of every member filled up to so many rows, shapes (members, rows, n) and (members, rows)."""

    def fill(parts: Sequence[np.ndarray], value: float) -> np.ndarray:
        found = np.full((len(parts), rows, *parts[0].shape[1:]), value, parts[0].dtype)
        for line, part in zip(found, parts, strict=True):
            line[: len(part)] = part
        return found

    return Batch(
        fill([one.inputs for one in drawn], 0.0),
        fill([one.condition.astype(np.int64) for one in drawn], 0),
        fill([one.wanted for one in drawn], np.nan),
    )


def _paces(stack: Sequence[Learner], steps: np.ndarray) -> np.ndarray:
    """What a step of Adam does with every member, shape (steps, 4, members, 1).

    That is how fast its two memories follow, and how far W and p go. All are 0 for a member that has no batch left.
    """
    found = np.zeros((int(steps.max()), 4, len(stack), 1), np.float32)
    for member, learner in enumerate(stack):
        config, before = learner.config, learner.optimiser.time
        for step in range(int(steps[member])):
            pace = one_cycle((learner.epoch + step / int(steps[member])) / config.epochs)
            time = before + step + 1
            gain = pace * np.sqrt(1.0 - SQUARES**time) / (1.0 - MOMENTUM**time)
            found[step, :, member, 0] = 1.0 - MOMENTUM, 1.0 - SQUARES, gain * config.rate, gain * config.bias_rate
    return found


def _straight(stack: Sequence[Learner], usual: Sequence[float], device: str) -> "torch.Tensor":
    import torch

    bounds = [float(learner.straight(one)) for learner, one in zip(stack, usual, strict=True)]
    return torch.tensor(bounds, device=device)[:, None, None]


def _held_out(stack: Sequence[Learner], numbers: "_Numbers", device: str) -> list[float]:
    """Held-out losses; infinite where there is nothing to measure."""
    import torch

    drawn = [learner.held.take(*learner.measure) for learner in stack]
    whole = _side_by_side(drawn, max(1, *(len(one.inputs) for one in drawn)))
    inputs, condition, wanted = (torch.from_numpy(part).to(device) for part in whole)
    straight = _straight(stack, [HUBER[1]] * len(stack), device)
    found = numbers.loss(inputs, condition, wanted, straight).cpu().numpy()
    return [float(loss) if len(one.inputs) else float("inf") for loss, one in zip(found, drawn, strict=True)]


class _Numbers:
    """W and p of all members, shapes (members, n) and (members, conditions, bias_size), on a device."""

    def __init__(self, stack: Sequence[Learner], device: str) -> None:
        import torch

        def up(parts: Sequence[np.ndarray]) -> torch.Tensor:
            return torch.from_numpy(np.stack(parts)).to(device)

        self._stack, self._form = stack, stack[0].chain.form
        self._flat = up([learner.chain.flat for learner in stack]).requires_grad_()
        self._p = up([learner.biases for learner in stack]).requires_grad_()
        self._moves = up([learner.moves.astype(np.float32) for learner in stack])
        self._memory = [
            [up([one.state()[name] for one in kind]) for name in ("slow", "square")]
            for kind in ([one.optimiser for one in stack], [one.bias_optimiser for one in stack])
        ]

    def loss(
        self, inputs: "torch.Tensor", condition: "torch.Tensor", wanted: "torch.Tensor", straight: "torch.Tensor"
    ) -> "torch.Tensor":
        """Of every member, shape (members,), as `compiled.learning.missed` has it.

        Args:
            inputs: Shape (members, rows, n_in without p).
            condition: Shape (members, rows).
            wanted: Shape (members, rows, n_out); NaN where nothing is known.
            straight: Shape (members, 1, 1).
        """
        import torch

        if self._p.shape[-1]:
            index = condition[:, :, None].expand(-1, -1, self._p.shape[-1])
            inputs = torch.cat([inputs, torch.gather(self._p, 1, index)], dim=2)
        told = forward(self._flat, self._form, inputs)
        known = torch.isfinite(wanted)
        miss = torch.where(known, told - torch.nan_to_num(wanted), 0.0)
        bound = torch.minimum(torch.maximum(miss, -straight), straight)
        return (bound * (2.0 * miss - bound)).sum(dim=(1, 2)) / known.sum(dim=(1, 2)).clamp(min=1)

    def move(self, loss: "torch.Tensor", paces: "torch.Tensor") -> None:
        """One step of Adam, see `_paces`."""
        import torch

        numbers = [self._flat, self._p] if self._p.numel() else [self._flat]
        gradients = torch.autograd.grad(loss.sum(), numbers)
        with torch.no_grad():
            for index, (part, gradient) in enumerate(zip(numbers, gradients, strict=True)):
                line = gradient.flatten(1) if index == 0 else (gradient * self._moves).flatten(1)
                slow, square = self._memory[index]
                slow += paces[0] * (line - slow)
                square += paces[1] * (line * line - square)
                part -= (paces[2 + index] * slow / (square.sqrt() + 1e-8)).reshape(part.shape)

    def bring_back(self, steps: np.ndarray) -> None:
        """Into the learners, after so many steps of each, shape (members,)."""
        flat, p = (part.detach().cpu().numpy() for part in (self._flat, self._p))
        memory = [[part.cpu().numpy() for part in parts] for parts in self._memory]
        for member, learner in enumerate(self._stack):
            learner.chain.flat[:] = flat[member]
            learner.biases[:] = p[member]
            for index, optimiser in enumerate((learner.optimiser, learner.bias_optimiser)):
                for part, name in zip(memory[index], ("slow", "square"), strict=True):
                    optimiser.state()[name][:] = part[member]
                if index == 0 or learner.biases.size:
                    optimiser.time += int(steps[member])


def forward(flat: "torch.Tensor", form: np.ndarray, values: "torch.Tensor") -> "torch.Tensor":
    """Outputs of a stack of networks, shape (members, rows, n_out), from inputs (members, rows, n_in).

    Args:
        flat: Every W as compiled code has it, shape (members, n).
        form: Of the layers, see `compiled.chain.Packed`.
        values: The inputs.
    """
    import torch

    for line in form:
        wide, narrow, place = int(line[WIDE]), int(line[NARROW]), int(line[PLACE])
        middle = place + wide * narrow
        matrix = flat[:, place:middle].reshape(-1, wide, narrow)
        values = torch.baddbmm(flat[:, None, middle : middle + narrow], values, matrix)
        name = NAMES[int(line[CODE])]
        if name != LINEAR:
            values = getattr(torch.nn.functional, name)(values)
    return values


def sums(device: str, chain: Packed, rows: Rows, gates: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """What `MaskErrors.sums` gives, shape (masks, size), from a device of torch; `MaskErrors.gates` for the masks."""
    import torch

    given, aim, counts = (torch.from_numpy(part).to(device) for part in rows[:3])
    flat, lacking = (torch.from_numpy(part).to(device) for part in (chain.flat[None], (~rows.whole).astype(np.float32)))
    size, found = aim.shape[1], np.empty((len(masks), aim.shape[1]))
    x, p = given[None, :, :size], given[None, :, size:]
    step = max(1, TOGETHER // max(1, len(given)))
    with torch.no_grad():
        for begin in range(0, len(masks), step):
            gate, bits = (torch.from_numpy(part[begin : begin + step]).to(device) for part in (gates, masks))
            shape = (len(bits), len(given), -1)
            inputs = torch.cat([x * gate[:, None], bits[:, None].expand(shape), p.expand(shape)], dim=2)
            told = forward(flat, chain.form, inputs.reshape(1, -1, inputs.shape[2])).reshape(shape)
            is_usable = (bits @ lacking.T < 0.5)[:, :, None]
            squared = (told - aim) ** 2 * counts * is_usable
            found[begin : begin + step] = squared.sum(dim=1, dtype=torch.float64).cpu().numpy()
    return found
