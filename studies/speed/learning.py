"""Training and structure determination beside what a user would write in torch first.

    python -m studies.speed.learning [--epochs 6]

Training, one thread each: epochs of a muscle-driven arm, a tool arm and a humanoid in size, ten thousand samples,
random masks. Beside it a Dataset with a DataLoader, plain Adam and the mask drawn per sample. Structure, both on all
cores: which masks of ten signals are feasible, from one network that was trained for it, beside a loop over masks and
batches.
"""

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from gemuco import dataset as episodes
from gemuco.layers import Chain
from gemuco.learning import cores
from gemuco.learning.train import TrainConfig, fit
from gemuco.masks import Mask, all_masks, bits
from gemuco.schema import BodySchema
from gemuco.signals import Layout, Signal
from gemuco.structure.determination import Judge, Structure, Thresholds, select
from gemuco.structure.mask_training import train_masks
from studies.accuracy.synthetic_body import SyntheticBody
from studies.speed.bodies import modules
from studies.speed.table import Row, faster, side_by_side

SIZES = {
    "musashi_arm": ({"q": (5, "rad"), "f": (10, "N"), "l": (10, "m")}, (200, 30), 15, (("q", "f"), ("f", "l"))),
    "pr2_duster": ({"q": (7, "rad"), "x": (3, "m")}, (128, 128), 32, (("q",), ("q", "x"))),
    "kxr_humanoid": (
        {"q": (4, "rad"), "c": (2, "m"), "x": (3, "m"), "s": (2, "px")},
        (100, 100),
        8,
        (("q",), ("q", "c")),
    ),
}
SAMPLES, BATCH, RUNS = 10_000, 100, 5
TRAINED = TrainConfig(hidden=(200, 100), latent=20, epochs=60, batch=500, rate=3e-3)


class Samples(Dataset):  # type: ignore[type-arg]
    """One sample and one random mask at a time, as a tutorial would have it."""

    def __init__(self, x: np.ndarray, inputs: np.ndarray, gates: np.ndarray, tails: np.ndarray) -> None:
        self.x, self.inputs, self.gates, self.tails = x.astype(np.float32), inputs, gates, tails

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        m = np.random.randint(len(self.gates))
        return np.concatenate([self.x[index, self.inputs] * self.gates[m], self.tails[m]]), self.x[index]


def manifold(size: int, seed: int = 0) -> np.ndarray:
    """Samples that four numbers decide, shape (SAMPLES, size), of variance 1."""
    random = np.random.default_rng(seed)
    hidden = np.tanh(random.standard_normal((SAMPLES, 4)) @ random.standard_normal((4, 30)))
    x = hidden @ random.standard_normal((30, size))
    return (x - x.mean(axis=0)) / x.std(axis=0)


def training(name: str, epochs: int) -> Row:
    """Seconds of so many epochs, without what a call costs beside them."""
    signals, hidden, latent, sets = SIZES[name]
    masks = tuple(frozenset(one) for one in sets)
    layout = Layout(tuple(Signal(signal, size, unit) for signal, (size, unit) in signals.items()))
    x = manifold(layout.size)
    parts = tuple(episodes.Episode("", layout.split(part)) for part in np.array_split(x, 20))
    data = episodes.Dataset(layout, parts)
    config = TrainConfig(hidden=hidden, latent=latent, batch=BATCH, rate=3e-3, outliers=math.inf)
    fit(data, replace(config, epochs=1), masks)  # imports
    took, found = np.empty((RUNS, 2)), np.empty((RUNS, 2))
    for run in range(RUNS):
        whole = []
        for count in (1, epochs + 1):
            begun = time.process_time()
            schema, history = fit(data, replace(config, epochs=count, seed=run), masks)
            whole.append(time.process_time() - begun)
        begun = time.process_time()
        found[run] = history.best, by_hand(schema, x, masks, epochs, run)
        took[run] = whole[1] - whole[0], time.process_time() - begun
    ours, theirs = np.median(took, axis=0)
    mine, other = found.mean(axis=0)
    note = f"{epochs} epochs, medians of {RUNS} runs; mean held-out loss {mine:.4f} against {other:.4f}"
    ratio = float(np.median(took[:, 1] / took[:, 0]))
    return Row(f"training, {name}", "torch with DataLoader", float(ours), float(theirs), "s", ratio, 4.0, note=note)


def by_hand(schema: BodySchema, x: np.ndarray, masks: tuple[Mask, ...], epochs: int, seed: int) -> float:
    """Train the tutorial's way; its held-out loss."""
    torch.manual_seed(seed)
    np.random.seed(seed)
    network = nn.Sequential(*modules(schema))
    for part in network.modules():
        if isinstance(part, nn.Linear):
            part.reset_parameters()
    gates, tails = (np.stack(column) for column in zip(*(schema.gate(m) for m in masks), strict=True))
    train = DataLoader(Samples(x[:9000], schema.in_index, gates, tails), batch_size=BATCH, shuffle=True)
    held = DataLoader(Samples(x[9000:], schema.in_index, gates, tails), batch_size=BATCH)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    best = np.inf
    for _ in range(epochs):
        for given, wanted in train:
            optimiser.zero_grad()
            loss = nn.functional.mse_loss(network(given), wanted)
            loss.backward()
            optimiser.step()
        with torch.no_grad():
            best = min(best, float(np.mean([float(nn.functional.mse_loss(network(g), w)) for g, w in held])))
    return best


def structure() -> Row:
    """Which of all masks of ten signals are feasible, on 1000 rows and with a network that was trained for it.

    Only such a network has a border between feasible and hopeless masks, which is what a race is about.
    """
    made = SyntheticBody.random(10, 0)
    names = made.layout.names
    judge = Judge(names, train_masks(made.sample(SAMPLES, 0), TRAINED), Thresholds())
    (errors,) = judge.errors
    masks = np.array([bits(m, names) > 0 for m in all_masks(names)])
    masks = masks[judge.is_judged(masks)]
    sizes = [signal.size for signal in made.layout.signals]
    network, data = torch_chain(errors.chain), torch.from_numpy(errors.x)

    @torch.no_grad()
    def by_torch() -> np.ndarray:
        found = []
        for line in masks:
            gate = torch.from_numpy(np.repeat(line, sizes).astype(np.float32))
            tail = torch.from_numpy(line.astype(np.float32))
            squared = [
                (network(torch.cat([part * gate, tail.expand(len(part), -1)], dim=1)) - part) ** 2
                for part in data.split(BATCH)
            ]
            judged = torch.from_numpy(np.repeat(judge.outputs & ~line, sizes))
            found.append(float(torch.cat(squared)[:, judged].mean()))
        return np.array(found)

    torch.set_num_threads(cores.count())

    def by_race() -> Structure:
        return select(made.layout, judge, masks, True, 0)

    theirs, ours = by_torch(), by_race()
    found, is_rough = (
        np.array([one(frozenset(np.array(names)[line])) for line in masks])
        for one in (ours.L_m.__getitem__, ours.rough.__contains__)
    )
    np.testing.assert_array_equal(found < 0.15, theirs < 0.15)
    np.testing.assert_allclose(found[~is_rough], theirs[~is_rough], rtol=2e-3)
    _, every, whole = side_by_side(by_race, lambda: judge.of(masks), rounds=3)
    note = (
        f"on {cores.count()} cores; both find the same {len(ours.feasible)} of {len(masks)} masks feasible, and the "
        f"same L_m of the {len(ours.masks)} that a schema would keep; the choice of these is in our time. Of "
        f"{is_rough.mean():.0%} few rows told enough. All masks on all rows take ours {every / 1e6:.2f} s, "
        f"{whole:.2f} times as long"
    )
    row = faster(
        "structure, 10 signals, all 1023 masks x 1000 rows", "loop over masks in torch", by_race,
        by_torch, 20.0, note, rounds=5,
    )  # fmt: skip
    torch.set_num_threads(1)
    return row


def torch_chain(chain: Chain) -> nn.Sequential:
    """The same network in torch."""
    parts: list[nn.Module] = []
    for matrix, offset, activation in chain:
        linear = nn.Linear(*matrix.shape)
        linear.weight.data, linear.bias.data = torch.from_numpy(matrix.T.copy()), torch.from_numpy(offset.copy())
        parts += [linear] if activation == "linear" else [linear, nn.Tanh()]
    return nn.Sequential(*parts)


def rows(epochs: int = 6) -> Iterator[Row]:
    """All of them."""
    torch.set_num_threads(1)
    for name in SIZES:
        yield training(name, epochs)
    yield structure()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=6)
    for row in rows(parser.parse_args().epochs):
        figures = f"{row.ours:9.2f} {row.theirs:9.2f} {row.unit}  {row.value:6.1f} x (bar {row.bar:g})"
        print(f"{row.what:55s} {figures}  {row.note}")


if __name__ == "__main__":
    main()
