"""Training (paper, II-D): W and every p together, each sample under a random feasible mask that its data allow."""

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from gemuco.activation import check
from gemuco.anomaly import Normal
from gemuco.dataset import Dataset
from gemuco.errors import NotEnoughData
from gemuco.estimate import STARTS, latent_search
from gemuco.masks import Mask, all_masks, bits, label, mask
from gemuco.network import Network
from gemuco.scaler import CLIP, Scaler
from gemuco.schema import BodySchema

Progress = Callable[[float, str], None]
"""Called with the share that is done, 0 to 1, and one line of text."""

ANCHORS = 1000


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """How to train.

    Attributes:
        hidden: Widths of the encoder's layers; the decoder mirrors them.
        latent: Length of z.
        activation: What bends the layers: tanh, sigmoid, relu, elu or softplus.
        bias_size: Length of p, one p per condition; 0 without parametric bias.
        epochs: At most so many passes over the data.
        batch: Samples per step.
        rate: Peak of the one-cycle learning rate of W (Adam).
        bias_rate: Learning rate of p.
        held_out: Share of the episodes (or time blocks) that only measures.
        patience: Stop after so many epochs without a better held-out loss.
        seed: For the split, the first weights, the masks and the order of samples.
    """

    hidden: tuple[int, ...] = (200, 30)
    latent: int = 15
    activation: str = "tanh"
    bias_size: int = 0
    epochs: int = 150
    batch: int = 500
    rate: float = 1e-2
    bias_rate: float = 1e-2
    held_out: float = 0.2
    patience: int = 40
    seed: int = 0

    def __post_init__(self) -> None:
        check(self.activation)


@dataclass(frozen=True, slots=True)
class History:
    """How training went: mean squared errors [standard deviations squared] after every epoch.

    Attributes:
        train: Loss on the training data while it was learned, one per epoch.
        held_out: Loss on held-out data, one per epoch.
        best_epoch: Whose weights were kept, counted from 0.
    """

    train: tuple[float, ...]
    held_out: tuple[float, ...]
    best_epoch: int


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: on layers this small a second one only waits (256 samples: 1.7 ms against 42 ms)."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(slots=True)
class _Material:
    """Rows ready for the network: normalised, with gaps filled by zero and remembered."""

    x_in: torch.Tensor  # (rows, in_size), clipped
    x_out: torch.Tensor  # (rows, out_size)
    there: torch.Tensor  # (rows, out_size), 1 where x_out was measured
    allowed: torch.Tensor  # (rows, masks), whether the row has all that a mask needs
    condition: torch.Tensor  # (rows,)


class _Trainer:
    """The network, its data and its masks during one training."""

    def __init__(self, data: Dataset, config: TrainConfig, masks: tuple[Mask, ...], x_out: tuple[str, ...]) -> None:
        layout = data.layout
        self.layout, self.config, self.masks, self.x_out = layout, config, masks, x_out
        self.x_in = tuple(name for name in layout.names if any(name in m for m in masks))
        self.data = data
        self.train_data, self.held_data = data.split(config.held_out, config.seed)
        self.scaler = Scaler.fit(layout, self.train_data.rows())
        gates = np.stack([bits(m, self.x_in) for m in masks])
        self.tails = torch.from_numpy(gates)
        sizes = [layout.signal(name).size for name in self.x_in]
        self.through = torch.from_numpy(np.repeat(gates, sizes, axis=1))
        self.material = self._material(self.train_data)
        self.held = self._material(self.held_data, limit=2000)
        if not self.material.allowed.any():
            names = ", ".join(label(m, layout.names) for m in masks)
            raise NotEnoughData(f"No training sample has all signals of any mask ({names}); check what was recorded.")
        torch.manual_seed(config.seed)
        inputs = self.through.shape[1] + len(self.x_in) + config.bias_size
        self.network = Network(inputs, len(layout.indices(x_out)), config.hidden, config.latent, config.activation)
        self.biases = torch.nn.Parameter(torch.zeros(len(data.conditions), config.bias_size))
        self.generator = torch.Generator().manual_seed(config.seed)

    def _material(self, data: Dataset, limit: int | None = None) -> _Material:
        x = self.scaler.normalise(data.rows())
        order = {c: i for i, c in enumerate(self.data.conditions)}
        condition = np.array([order[c] for c in data.conditions], int)[data.condition_of_rows()]
        usable = np.isfinite(x).any(axis=1)
        x, condition = x[usable], condition[usable]
        if limit is not None and len(x) > limit:
            chosen = np.linspace(0, len(x) - 1, limit).astype(int)
            x, condition = x[chosen], condition[chosen]
        finite = np.isfinite(x)
        whole = {name: finite[:, self.layout.slice(name)].all(axis=1) for name in self.layout.names}
        allowed = np.stack([np.all([whole[name] for name in m], axis=0) for m in self.masks], axis=1)
        filled = np.where(finite, x, 0.0)
        into, out = self.layout.indices(self.x_in), self.layout.indices(self.x_out)
        return _Material(
            torch.from_numpy(np.clip(filled[:, into], -CLIP, CLIP).astype(np.float32)),
            torch.from_numpy(filled[:, out].astype(np.float32)),
            torch.from_numpy(finite[:, out].astype(np.float32)),
            torch.from_numpy(allowed),
            torch.from_numpy(condition),
        )

    def loss(self, material: _Material, rows: torch.Tensor, chosen: torch.Tensor) -> torch.Tensor:
        """Mean squared error of some rows, each under its mask, over what was measured."""
        parts = [material.x_in[rows] * self.through[chosen], self.tails[chosen]]
        if self.config.bias_size:
            parts.append(self.biases[material.condition[rows]])
        difference = self.network(torch.cat(parts, dim=1)) - material.x_out[rows]
        there = material.there[rows]
        return (there * difference.square()).sum() / there.sum().clamp(min=1.0)

    def batches(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """One pass over the training rows in random order, each with a random mask it allows."""
        allowed = self.material.allowed
        usable = torch.nonzero(allowed.any(dim=1)).squeeze(1)
        order = usable[torch.randperm(len(usable), generator=self.generator)]
        for rows in order.split(self.config.batch):
            draw = torch.rand(len(rows), len(self.masks), generator=self.generator)
            yield rows, torch.where(allowed[rows], draw, -1.0).argmax(dim=1)

    @torch.no_grad()
    def held_out_loss(self) -> float:
        """Mean over the masks of the held-out loss under each."""
        losses: list[float] = []
        for index in range(len(self.masks)):
            rows = torch.nonzero(self.held.allowed[:, index]).squeeze(1)
            if len(rows):
                losses.append(float(self.loss(self.held, rows, torch.full((len(rows),), index))))
        return float(np.mean(losses)) if losses else math.inf

    def train(self, progress: Progress | None, title: str) -> History:
        """Adam with a one-cycle rate; keeps the weights of the best held-out loss."""
        config = self.config
        steps = config.epochs * math.ceil(int(self.material.allowed.any(dim=1).sum()) / config.batch)
        groups = [{"params": list(self.network.parameters()), "lr": config.rate}]
        peaks = [config.rate]
        if config.bias_size:
            groups.append({"params": [self.biases], "lr": config.bias_rate})
            peaks.append(config.bias_rate)
        optimiser = torch.optim.Adam(groups, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=peaks, total_steps=steps)
        train: list[float] = []
        held_out: list[float] = []
        best_epoch, best_state, best_biases = 0, self._state(), self.biases.detach().clone()
        for epoch in range(config.epochs):
            losses: list[torch.Tensor] = []
            for rows, chosen in self.batches():
                optimiser.zero_grad(set_to_none=True)
                loss = self.loss(self.material, rows, chosen)
                loss.backward()
                optimiser.step()
                schedule.step()
                losses.append(loss.detach())
            train.append(float(torch.stack(losses).mean()))
            held_out.append(self.held_out_loss())
            if epoch == 0 or held_out[-1] < held_out[best_epoch]:
                best_epoch, best_state, best_biases = epoch, self._state(), self.biases.detach().clone()
            if progress is not None:
                progress((epoch + 1) / config.epochs, f"{title}: held-out loss {held_out[best_epoch]:.4f}")
            if epoch - best_epoch >= config.patience:
                break
        self.network.load_state_dict(best_state)
        self.biases.data.copy_(best_biases)
        return History(tuple(train), tuple(held_out), best_epoch)

    def _state(self) -> dict[str, torch.Tensor]:
        return {name: tensor.clone() for name, tensor in self.network.state_dict().items()}

    def schema(self) -> BodySchema:
        """What was learned, without errors and normal statistics."""
        rows = self.scaler.normalise(self.train_data.rows())
        complete = np.flatnonzero(np.isfinite(rows).all(axis=1))
        chosen = complete[np.random.default_rng(self.config.seed).permutation(len(complete))[:ANCHORS]]
        order = np.array([self.data.conditions.index(c) for c in self.train_data.conditions], int)
        biases = {c: p.numpy().copy() for c, p in zip(self.data.conditions, self.biases.detach(), strict=True)}
        size = self.config.bias_size
        return BodySchema(
            layout=self.layout,
            x_in=self.x_in,
            x_out=self.x_out,
            masks=self.masks,
            scaler=self.scaler,
            weights=self.network.weights(),
            anchors=rows[chosen].astype(np.float32),
            anchor_conditions=order[self.train_data.condition_of_rows()[chosen]] if size else np.zeros(0, int),
            bias=np.mean(list(biases.values()), axis=0) if size else np.zeros(0, np.float32),
            biases=biases if size else {},
        )


def fit(
    dataset: Dataset,
    config: TrainConfig,
    masks: Iterable[Iterable[str]],
    progress: Progress | None = None,
    x_out: Iterable[str] | None = None,
    title: str = "training",
) -> tuple[BodySchema, History]:
    """Train a body schema.

    Args:
        dataset: Episodes of one body.
        config: How.
        masks: The feasible masks; their union is x_in.
        progress: Called after every epoch.
        x_out: What to infer; every signal if not given.
        title: Begins the progress text.

    Returns:
        The schema with its held-out errors and the statistics of the normal, and how training went.

    Raises:
        NotEnoughData: Too few samples to hold some out, or none that fits a mask.
        UnknownSignal: A mask or x_out names a signal that is not in the layout.
    """
    layout = dataset.layout
    checked = tuple(mask(m, layout.names) for m in masks)
    if not checked or frozenset() in checked:
        raise NotEnoughData("Training needs at least one mask, and none of them empty.")
    outputs = layout.subset(layout.names if x_out is None else x_out).names
    with one_thread():
        trainer = _Trainer(dataset, config, checked, outputs)
        history = trainer.train(progress, title)
        schema = trainer.schema()
    held = trainer.held_data.rows()
    schema = schema.with_weights(schema.weights, measure_errors(schema, held))
    try:
        errors = schema.predict_error(layout.split(held))
        schema = schema.with_normal(Normal.fit(errors, schema.scaler.std[schema.out_index]))
    except NotEnoughData:
        schema = schema.with_normal(None)
    return schema, history


def measure_errors(schema: BodySchema, rows: np.ndarray) -> dict[tuple[str, Mask], np.ndarray]:
    """Root mean square errors of every way to estimate.

    Args:
        schema: The body schema.
        rows: Held-out samples [unit], shape (samples, size), NaN where nothing was measured.

    Returns:
        (method, signals given) -> error of every x_out element [unit], shape (out_size,).
    """
    x = schema.scaler.normalise(rows)
    truth, scale = x[:, schema.out_index], schema.scaler.std[schema.out_index]
    found: dict[tuple[str, Mask], np.ndarray] = {}
    for m in schema.masks:
        there = np.isfinite(x[:, schema.layout.indices(m)]).all(axis=1)
        if there.any():
            found["mask", m] = _rms(schema.infer(x[there], m) - truth[there]) * scale
    complete = x[np.isfinite(x).all(axis=1)]
    some = complete[np.linspace(0, len(complete) - 1, min(STARTS, len(complete))).astype(int)] if len(complete) else []
    for given in all_masks(schema.x_out):
        if len(some) and len(given) < len(schema.x_out) and not any(m <= given for m in schema.masks):
            hidden = np.array(some)
            hidden[:, ~np.isin(np.arange(x.shape[1]), schema.layout.indices(given))] = np.nan
            guesses = np.stack([latent_search(schema, row) for row in hidden])
            found["latent", given] = _rms(guesses - np.array(some)[:, schema.out_index]) * scale
    return found


def _rms(errors: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.nanmean(errors**2, axis=0))
