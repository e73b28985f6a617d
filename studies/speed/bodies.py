"""Bodies of any size with random W, and the same networks in torch."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import nn
from typing_extensions import override

from gemuco.layers import Chain, Layer, Weights
from gemuco.scaler import Scaler
from gemuco.schema import BodySchema
from gemuco.signals import Layout, Signal

MUSCLES = {"joint_position": (5, "rad"), "muscle_tension": (10, "N"), "muscle_length": (10, "m")}
MASKS = (
    frozenset({"muscle_tension", "muscle_length"}),
    frozenset({"joint_position", "muscle_tension"}),
    frozenset({"joint_position", "muscle_length"}),
)


def body(
    hidden: Sequence[int],
    latent: int = 15,
    bias: int = 0,
    signals: dict[str, tuple[int, str]] | None = None,
    masks: Sequence[frozenset[str]] = MASKS,
    anchors: int = 0,
) -> BodySchema:
    """Return a body of the size of a muscle-driven arm, or of other signals; all signals are inputs and outputs."""
    signals = signals or MUSCLES
    random = np.random.default_rng(0)
    layout = Layout(tuple(Signal(name, size, unit) for name, (size, unit) in signals.items()))
    ends = (layout.size + len(signals) + bias, *hidden, latent, *reversed(hidden), layout.size)
    inner = len(hidden) + 1
    layers = tuple(
        Layer(
            (random.standard_normal((wide, narrow)) / np.sqrt(wide)).astype(np.float32),
            (0.1 * random.standard_normal(narrow)).astype(np.float32),
            "linear" if index in (inner - 1, len(ends) - 2) else "tanh",
        )
        for index, (wide, narrow) in enumerate(pairwise(ends))
    )
    zeros, ones = np.zeros(layout.size), np.ones(layout.size)
    conditions = {name: random.standard_normal(bias).astype(np.float32) for name in ("a", "b", "c")} if bias else {}
    return BodySchema(
        layout,
        layout.names,
        layout.names,
        tuple(masks),
        Scaler(zeros, ones, -ones, ones),
        Weights(layers[:inner], layers[inner:]),
        anchors=random.standard_normal((anchors, layout.size)).astype(np.float32),
        anchor_conditions=random.integers(0, 3, anchors) if bias else np.zeros(0, int),
        bias=np.zeros(bias, np.float32),
        biases=conditions,
    )


def modules(schema: BodySchema) -> tuple[nn.Sequential, nn.Sequential]:
    """Return encoder and decoder of a schema in torch."""
    return module(schema.weights.encoder), module(schema.weights.decoder)


class PartTanh(nn.Module):
    """The activation of a hidden layer whose last columns carry the linear path."""

    def __init__(self, bent: int) -> None:
        super().__init__()
        self.bent = bent

    @override
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Apply tanh to the first columns, shape (..., n)."""
        return torch.cat([torch.tanh(x[..., : self.bent]), x[..., self.bent :]], dim=-1)


def module(chain: Chain) -> nn.Sequential:
    """Return a chain of layers in torch."""
    parts: list[nn.Module] = []
    for layer in chain:
        linear = nn.Linear(*layer.matrix.shape)
        linear.weight.data = torch.from_numpy(layer.matrix.T.copy())
        linear.bias.data = torch.from_numpy(layer.offset.copy())
        parts.append(linear)
        if layer.bent:
            parts.append(PartTanh(layer.bent) if layer.straight else nn.Tanh())
    return nn.Sequential(*parts)
