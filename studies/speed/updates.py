"""Inference by mask, recognition of p and the step on W beside torch eager, one thread each.

python -m studies.speed.updates
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import nn

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.recognise import Kalman
from gemuco.adaption.relearn import Relearner
from gemuco.adaption.update import Updater
from gemuco.compiled.inference import infer
from gemuco.estimation import estimate
from gemuco.schema import BodySchema
from services.process.realtime import freeze
from studies.speed.bodies import MASKS, body, modules
from studies.speed.table import Row, faster

SAMPLES = 50
STEPS = 10


def rows() -> Iterator[Row]:
    """All of them."""
    torch.set_num_threads(1)
    freeze()  # as the service does
    yield from inference()
    yield from recognition()
    yield step_on_weights()


def inference() -> Iterator[Row]:
    """One sample in raw units, one mask, the whole x_out in raw units."""
    schema = body((200, 200))
    encoder, decoder = modules(schema)
    network = nn.Sequential(encoder, decoder)
    mask = MASKS[0]
    random = np.random.default_rng(1)
    values = {name: random.standard_normal(schema.layout.signal(name).size) for name in mask}
    joined = schema.layout.join(values)
    gate, tail = schema.gate(mask)
    mean, std = schema.scaler.mean, schema.scaler.std

    @torch.inference_mode()
    def by_torch() -> np.ndarray:
        given = np.concatenate([np.where(gate > 0, (joined - mean) / std, 0.0), tail]).astype(np.float32)
        return network(torch.from_numpy(given)).numpy() * std + mean

    parts, every = schema.parts, np.ones(len(joined), bool)

    def ours() -> np.ndarray:
        found = np.empty(len(joined))
        infer(*parts, joined, gate, tail, every, found)
        return found

    np.testing.assert_allclose(ours(), by_torch(), rtol=1e-3, atol=1e-4)
    row = faster(
        "estimate by mask, hidden 200, arrays in and out",
        "torch nn.Module",
        ours,
        by_torch,
        6.0,
    )
    yield row
    yield Row("the same, longest that it may take", "20 us", row.ours, 20.0, "us", row.ours, 20.0, is_most=True)

    @torch.inference_mode()
    def named_by_torch() -> dict[str, np.ndarray]:
        found = by_torch()
        return {name: found[span] for name, span in schema.layout.slices.items()}

    yield faster(
        "gemuco.estimate: named arrays, with std, method and residual",
        "torch nn.Module, taken apart by name",
        lambda: estimate(schema, values),
        named_by_torch,
        0.0,
        "no bar was named",
    )


def recognition() -> Iterator[Row]:
    """P from one sample that allows three masks."""
    schema = body((200, 200), bias=2, anchors=300)
    random = np.random.default_rng(2)
    sample = random.standard_normal(schema.layout.size)
    seen = Kalman(schema)
    for _ in range(20):  # until the bank of filters is full
        seen.see(schema, random.standard_normal(schema.layout.size))
    what, against = "p update per sample, 3 masks, hidden 200", f"torch eager, {STEPS} gradient steps"
    note = f"a bank of {seen._count} beliefs, each linearised at most twice"
    yield faster(what, against, lambda: seen.see(schema, sample), torch_recognition(schema, sample, False), 20.0, note)
    yield faster(
        "the same p update",
        f"{against}, gradients of W switched off by hand",
        lambda: seen.see(schema, sample),
        torch_recognition(schema, sample, True),
        0.0,
        "no bar was named",
    )


def torch_recognition(schema: BodySchema, sample: np.ndarray, is_frozen: bool) -> Callable[[], np.ndarray]:
    """P by gradient steps, as a user would write it: Adam has p alone, but W gets a gradient unless told not to."""
    encoder, decoder = modules(schema)
    for parameter in (*encoder.parameters(), *decoder.parameters()):
        parameter.requires_grad_(not is_frozen)
    gates, tails = (np.stack(part) for part in zip(*(schema.gate(m) for m in MASKS), strict=True))
    mean, std, masks = schema.scaler.mean, schema.scaler.std, tails[:, : len(schema.x_in)]

    def by_torch() -> np.ndarray:
        x = (sample - mean) / std
        given = np.concatenate([np.where(gates > 0, x, 0.0), masks], axis=1).astype(np.float32)
        inputs, wanted = torch.from_numpy(given), torch.from_numpy(x.astype(np.float32)).expand(len(MASKS), -1)
        p = torch.zeros(2, requires_grad=True)
        optimiser = torch.optim.Adam([p], lr=0.02)
        for _ in range(STEPS):
            optimiser.zero_grad()
            told = decoder(encoder(torch.cat([inputs, p.expand(len(MASKS), 2)], dim=1)))
            nn.functional.mse_loss(told, wanted).backward()
            optimiser.step()
        return p.detach().numpy()

    return by_torch


def step_on_weights() -> Row:
    """One step of Adam on W: fifty samples under every mask that they allow."""
    schema = body((200, 200), anchors=300)
    config = UpdateConfig(what="weights", steps=1, batch=SAMPLES, replay=0, held_out=0, minimum=1)
    updater = Updater(schema, config)
    random = np.random.default_rng(3)
    lived = random.standard_normal((200, schema.layout.size))
    for line in lived:
        updater.add(schema.layout.split(line))
    relearner: Relearner = updater._relearner
    return faster(
        f"W update, {SAMPLES} samples x 3 masks, hidden 200",
        "torch eager with Adam",
        lambda: relearner.step(schema, True, False),
        torch_step(schema, lived, random),
        1.7,
        "drawing, masking and the check of W are in it",
    )


def torch_step(schema: BodySchema, lived: np.ndarray, random: np.random.Generator) -> Callable[[], float]:
    """The same in torch: draw, mask, forward, backward, Adam."""
    network = nn.Sequential(*modules(schema))
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-4)
    data = torch.from_numpy(lived.astype(np.float32))
    gates = [torch.from_numpy(schema.gate(m)[0]) for m in MASKS]
    tails = [torch.from_numpy(schema.gate(m)[1]) for m in MASKS]

    def step() -> float:
        drawn = data[torch.from_numpy(random.integers(0, len(data), SAMPLES))]
        inputs = torch.cat(
            [
                torch.cat([drawn * gate, tail.expand(SAMPLES, -1)], dim=1)
                for gate, tail in zip(gates, tails, strict=True)
            ]
        )
        optimiser.zero_grad()
        loss = nn.functional.mse_loss(network(inputs), drawn.repeat(len(gates), 1))
        loss.backward()
        optimiser.step()
        return loss.item()

    return step


def main() -> None:
    for row in rows():
        print(f"{row.what:55s} {row.ours:9.1f} {row.theirs:9.1f} us  {row.value:6.1f} x (bar {row.bar:g})  {row.note}")


if __name__ == "__main__":
    main()
