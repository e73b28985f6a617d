"""The network as torch sees it, z = h_enc(x_in, m, p), x_out = h_dec(z): the reference for compiled code."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn

from gemuco.layers import LINEAR, Chain, Layer, Weights, check_activation

MODULES: dict[str, type[nn.Module]] = {
    "tanh": nn.Tanh,
    "sigmoid": nn.Sigmoid,
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "softplus": nn.Softplus,
}


def _chain(sizes: Sequence[int], activation: str) -> nn.Sequential:
    layers: list[nn.Module] = []
    for index, (wide, narrow) in enumerate(pairwise(sizes)):
        if index:
            layers.append(MODULES[activation]())
        layers.append(nn.Linear(wide, narrow))
    return nn.Sequential(*layers)


def _linear(chain: nn.Sequential) -> list[nn.Linear]:
    return [layer for layer in chain if isinstance(layer, nn.Linear)]


class Network(nn.Module):
    """Encoder and decoder with an activation between linear layers; latent state and output are linear.

    Args:
        inputs: Length of x_in, m and p together.
        outputs: Length of x_out.
        hidden: Widths from the input to the latent state; the decoder mirrors them.
        latent: Length of z.
        activation: Name of the activation.
    """

    def __init__(self, inputs: int, outputs: int, hidden: Sequence[int], latent: int, activation: str = "tanh") -> None:
        super().__init__()
        self.activation = check_activation(activation)
        self.encoder = _chain([inputs, *hidden, latent], activation)
        self.decoder = _chain([latent, *reversed(hidden), outputs], activation)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return x_out, shape (samples, outputs), of inputs, shape (samples, inputs)."""
        return self.decoder(self.encoder(x))

    @property
    def linear(self) -> list[nn.Linear]:
        """Linear layers from the input to the output."""
        return _linear(self.encoder) + _linear(self.decoder)

    def weights(self) -> Weights:
        """Copy W into numpy arrays."""

        def export(chain: nn.Sequential) -> Chain:
            linear = _linear(chain)
            return tuple(
                Layer(
                    layer.weight.detach().numpy().T.copy(),
                    layer.bias.detach().numpy().copy(),
                    self.activation if index < len(linear) - 1 else LINEAR,
                )
                for index, layer in enumerate(linear)
            )

        return Weights(export(self.encoder), export(self.decoder))
