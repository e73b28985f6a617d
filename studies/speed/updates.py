"""Estimation by mask and the step on W beside torch eager, one thread each.

python -m studies.speed.updates
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import nn

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.compiled.inference import infer
from gemuco.estimation import estimate
from services.process.realtime import freeze
from studies.speed.bodies import MASKS, body, modules
from studies.speed.table import Row, faster, show

SAMPLES = 50


def rows() -> Iterator[Row]:
    """Measure estimation and the step on W."""
    torch.set_num_threads(1)
    freeze()  # as the service does
    yield from inference()
    yield step_on_weights()


def inference() -> Iterator[Row]:
    """Measure one sample in raw units under one mask, the whole x_out in raw units."""
    schema = body((200, 200))
    network = nn.Sequential(*modules(schema))
    mask = MASKS[0]
    random = np.random.default_rng(1)
    values = {name: random.standard_normal(schema.layout.signal(name).size) for name in mask}
    joined = schema.layout.join(values)
    gate, path, tail, direct = schema.gate(mask)
    mean, std = schema.scaler.mean, schema.scaler.std

    @torch.inference_mode()
    def by_torch() -> np.ndarray:
        given = np.concatenate([np.where(gate > 0, (joined - mean) / std, 0.0), tail]).astype(np.float32)
        return network(torch.from_numpy(given)).numpy() * std + mean

    parts, every = schema.parts, np.ones(len(joined), bool)

    def ours() -> np.ndarray:
        prediction = np.empty(len(joined))
        infer(*parts, joined, gate, path, tail, direct, every, prediction)
        return prediction

    np.testing.assert_allclose(ours(), by_torch(), rtol=1e-3, atol=1e-4)
    row = faster("estimate by mask, hidden 200, arrays in and out", "torch nn.Module", ours, by_torch, 6.0)
    yield row
    yield Row("the same, longest that it may take", "20 us", row.ours, 20.0, "us", row.ours, 20.0, is_most=True)

    @torch.inference_mode()
    def named_by_torch() -> dict[str, np.ndarray]:
        prediction = by_torch()
        return {name: prediction[span] for name, span in schema.layout.slices.items()}

    yield faster(
        "gemuco.estimate: named arrays, with std, method and residual",
        "torch nn.Module, taken apart by name",
        lambda: estimate(schema, values),
        named_by_torch,
        0.0,
        "no bar is set",
    )


def step_on_weights() -> Row:
    """Measure one step of Adam on W: fifty samples under every mask that they allow."""
    schema = body((200, 200), anchors=300)
    config = UpdateConfig(what="weights", steps=1, batch=SAMPLES, replay=0, held_out=0, minimum=1)
    updater = Updater(schema, config)
    random = np.random.default_rng(3)
    lived = random.standard_normal((200, schema.layout.size))
    for line in lived:
        updater.add(schema.layout.split(line))
    network = nn.Sequential(*modules(schema))
    gates, _, tails, _ = zip(*(map(torch.from_numpy, schema.gate(mask)) for mask in MASKS), strict=True)
    return faster(
        f"W update, {SAMPLES} samples x 3 masks, hidden 200",
        "torch eager with Adam",
        lambda: updater._relearner.step(schema, 1, True, False),
        torch_step(network, gates, tails, torch.from_numpy(lived.astype(np.float32)), random),
        1.7,
        "the time includes drawing, masking and the check of W",
    )


def torch_step(
    network: nn.Module,
    gates: tuple[torch.Tensor, ...],
    tails: tuple[torch.Tensor, ...],
    data: torch.Tensor,
    random: np.random.Generator,
) -> Callable[[], float]:
    """Return the same step in torch: draw, mask, forward, backward, Adam."""
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-4)

    def step() -> float:
        drawn = data[torch.from_numpy(random.integers(0, len(data), SAMPLES))]
        masked = [
            torch.cat([drawn * gate, tail.expand(SAMPLES, -1)], dim=1) for gate, tail in zip(gates, tails, strict=True)
        ]
        optimiser.zero_grad()
        loss = nn.functional.mse_loss(network(torch.cat(masked)), drawn.repeat(len(gates), 1))
        loss.backward()
        optimiser.step()
        return loss.item()

    return step


if __name__ == "__main__":
    show(rows())
