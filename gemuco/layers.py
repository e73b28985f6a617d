"""Forward and backward passes of the network on plain numpy arrays; no torch, no state.

A chain of layers is y = W_n(... a(x W_1 + b_1) ...) + b_n, with a the activation of each layer. The latent state and
the output are linear, so encoder, decoder and both together are all chains, and one set of functions serves them all.
Rows are samples. Derivatives carry the names of their direction: `pull` brings a gradient from the output to the input
(reverse mode), `push` brings a change of the input to the output (forward mode).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gemuco.activation import ACTIVATIONS, LINEAR


class Layer(NamedTuple):
    """One affine map and the name of the activation that follows: matrix (n_in, n_out), offset (n_out,)."""

    matrix: np.ndarray
    offset: np.ndarray
    activation: str


Chain = tuple[Layer, ...]
Trace = list[np.ndarray]
"""Input and the value after every layer, shapes (samples, n)."""


@dataclass(frozen=True, slots=True)
class Weights:
    """The network's W: z = encoder(x_in, m, p), x_out = decoder(z)."""

    encoder: Chain
    decoder: Chain

    @property
    def whole(self) -> Chain:
        """Encoder and decoder as one chain."""
        return self.encoder + self.decoder

    def arrays(self) -> list[np.ndarray]:
        """Every matrix and offset, in the order of the layers."""
        return [array for layer in self.whole for array in (layer.matrix, layer.offset)]

    def replaced(self, arrays: list[np.ndarray]) -> "Weights":
        """The same network with other numbers, given in the order of `arrays`."""
        layers = tuple(Layer(arrays[2 * i], arrays[2 * i + 1], layer.activation) for i, layer in enumerate(self.whole))
        return Weights(layers[: len(self.encoder)], layers[len(self.encoder) :])

    def astype(self, dtype: type) -> "Weights":
        """A copy in another precision (float64 for finite differences)."""
        return self.replaced([array.astype(dtype) for array in self.arrays()])


def run(chain: Chain, x: np.ndarray) -> np.ndarray:
    """Forward pass, shape (n_in,) or (samples, n_in) -> (n_out,) or (samples, n_out)."""
    for matrix, offset, activation in chain:
        x = x @ matrix
        x += offset
        if activation != LINEAR:
            ACTIVATIONS[activation].apply(x)
    return x


def trace(chain: Chain, x: np.ndarray) -> Trace:
    """Forward pass that keeps what the other passes need."""
    values = [x]
    for matrix, offset, activation in chain:
        x = x @ matrix
        x += offset
        if activation != LINEAR:
            ACTIVATIONS[activation].apply(x)
        values.append(x)
    return values


def pull(chain: Chain, values: Trace, gradient: np.ndarray) -> np.ndarray:
    """Gradient of a scalar with respect to the output -> with respect to the input, shapes (samples, n)."""
    for (matrix, _, activation), value in zip(reversed(chain), reversed(values), strict=False):
        if activation != LINEAR:
            gradient = gradient * ACTIVATIONS[activation].slope(value)
        gradient = gradient @ matrix.T
    return gradient


def push(chain: Chain, values: Trace, tangent: np.ndarray) -> np.ndarray:
    """Change of the input -> change of the output to first order, shapes (samples, n)."""
    for (matrix, _, activation), value in zip(chain, values[1:], strict=True):
        tangent = tangent @ matrix
        if activation != LINEAR:
            tangent *= ACTIVATIONS[activation].slope(value)
    return tangent


class Curvature:
    """First and mixed second derivatives of s = w . y(x): its gradient g = dy/dx^T w, then d(u . g)/dx for a fixed u.

    Forward over reverse: the tangent u is pushed forward through the net, and w . (dy/dx u) is pulled back again. The
    chain of gradients that the second pull needs is the one that gave g, so it is kept.
    """

    __slots__ = ("_chain", "_gradients", "_slopes", "_values", "gradient")

    def __init__(self, chain: Chain, x: np.ndarray, w: np.ndarray) -> None:
        """Run forward at x, shape (samples, n_in), and pull w, shape (samples, n_out), back to `gradient`."""
        self._chain = chain
        self._values = trace(chain, x)
        self._slopes: list[np.ndarray | None] = []
        self._gradients: list[np.ndarray] = []
        gradient = w
        for (matrix, _, activation), value in zip(reversed(chain), reversed(self._values), strict=False):
            slope = None if activation == LINEAR else ACTIVATIONS[activation].slope(value)
            self._slopes.append(slope)
            self._gradients.append(gradient)
            gradient = (gradient if slope is None else gradient * slope) @ matrix.T
        self._slopes.reverse()
        self._gradients.reverse()
        self.gradient = gradient

    def mixed(self, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What happens to u . g: (dy/dx u, shape (samples, n_out)) and (d(u . g)/dx, shape (samples, n_in))."""
        tangents: list[np.ndarray] = []
        for (matrix, _, _), slope in zip(self._chain, self._slopes, strict=True):
            tangent = tangent @ matrix
            tangents.append(tangent)
            if slope is not None:
                tangent = tangent * slope
        second: np.ndarray | None = None
        for index in range(len(self._chain) - 1, -1, -1):
            slope = self._slopes[index]
            if slope is not None:
                bend = ACTIVATIONS[self._chain[index].activation].bend(self._values[index + 1], slope)
                bend = bend * tangents[index] * self._gradients[index]
                second = bend if second is None else second * slope + bend
            if second is not None:
                second = second @ self._chain[index].matrix.T
        return tangent, np.zeros_like(self.gradient) if second is None else second
