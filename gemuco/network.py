"""z = h_enc(x_in, m, p), x_out = h_dec(z); nothing else lives here."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn

from gemuco.kernels import Layer, Weights


def _chain(sizes: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for index, (wide, narrow) in enumerate(pairwise(sizes)):
        if index:
            layers.append(nn.Tanh())
        layers.append(nn.Linear(wide, narrow))
    return nn.Sequential(*layers)


class Network(nn.Module):
    """Encoder and decoder, tanh between linear layers; the latent state and the output are linear.

    Args:
        inputs: Length of x_in, m and p together.
        outputs: Length of x_out.
        hidden: Widths from the input to the latent state; the decoder mirrors them.
        latent: Length of z.
    """

    def __init__(self, inputs: int, outputs: int, hidden: Sequence[int], latent: int) -> None:
        super().__init__()
        self.encoder = _chain([inputs, *hidden, latent])
        self.decoder = _chain([latent, *reversed(hidden), outputs])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Inputs (samples, inputs) -> x_out (samples, outputs)."""
        return self.decoder(self.encoder(x))

    def weights(self) -> Weights:
        """A copy of W for the numpy kernels."""

        def export(chain: nn.Sequential) -> tuple[Layer, ...]:
            linear = [layer for layer in chain if isinstance(layer, nn.Linear)]
            return tuple(
                Layer(
                    layer.weight.detach().numpy().T.copy(),
                    layer.bias.detach().numpy().copy(),
                    index < len(linear) - 1,
                )
                for index, layer in enumerate(linear)
            )

        return Weights(export(self.encoder), export(self.decoder))
