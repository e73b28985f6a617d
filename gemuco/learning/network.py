"""The network as torch sees it: z = h_enc(x_in, m, p), x_out = h_dec(z); and the first weights of a training."""

import threading
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import nn

from gemuco.layers import LINEAR, Chain, Layer, Weights, check_activation

_drawing = threading.Lock()
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


def first_weights(seed: int, inputs: int, outputs: int, hidden: Sequence[int], latent: int, activation: str) -> Weights:
    """Draw W; see `Network` for the sizes. Two trainings at once draw one after the other: torch has one source."""
    with _drawing:
        torch.manual_seed(seed)
        return Network(inputs, outputs, hidden, latent, activation).weights()


def with_linear_path(weights: Weights, outputs: np.ndarray, place: int) -> Weights:
    """Return a network that begins as its linear path: the code l goes to z and from there to the output.

    Args:
        weights: First weights of a network without linear path.
        outputs: x_out by the code and 1 (`LinearPath`), shape (width + 1, out_size); z is at least as long as the code.
        place: Position of the code in the network's input.
    """
    components, mean = outputs[:-1], outputs[-1]
    width = len(components)
    chains = []
    for chain in (weights.encoder, weights.decoder):
        layers = []
        for index, layer in enumerate(chain):
            is_last = index == len(chain) - 1
            wide, narrow = layer.matrix.shape
            is_first = index == 0
            rows = wide + (width if not is_first or chain is weights.encoder else 0)
            matrix = np.zeros((rows, narrow + (0 if is_last else width)), np.float32)
            offset = np.zeros(matrix.shape[1], np.float32)
            own = (
                np.delete(np.arange(rows), np.arange(place, place + width)) if rows > wide and is_first else slice(wide)
            )
            matrix[own, :narrow], offset[:narrow] = layer.matrix, layer.offset
            begin = (place if chain is weights.encoder else 0) if is_first else wide
            into = matrix[begin : begin + width]
            if not is_last:
                into[:, narrow:] = np.eye(width)
            elif chain is weights.encoder:
                matrix[:wide, :width], offset[:width] = 0.0, 0.0
                into[:, :width] = np.eye(width)
            else:
                matrix[:wide], offset[:] = 0.0, mean
                into[:] = components
            layers.append(Layer(matrix, offset, layer.activation, 0 if is_last else width))
        chains.append(tuple(layers))
    return Weights(*chains)
