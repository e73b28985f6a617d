"""Forward and backward passes of the network on plain numpy arrays, without state.

A chain of layers is y = W_n(... a(x W_1 + b_1) ...) + b_n, with a the activation of each layer. The latent state and
the output are linear, so the encoder, the decoder and the whole network are chains. The last columns of a hidden layer
may have no activation: they carry the linear path (`gemuco.linear`) past the others. Rows are samples. `pull`
propagates a gradient from the output to the input (reverse mode), `push` a change of the input to the output (forward
mode).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gemuco.errors import SchemaError

LINEAR = "linear"
"""The name of the activation that leaves a layer linear: the latent state and the output."""


class Activation(NamedTuple):
    """A function y = a(x), element by element.

    Slope and bend are functions of y alone, so a trace contains values only. This is possible for monotone functions;
    SiLU and GELU would also need x.

    Attributes:
        apply: x -> y, in place.
        slope: y -> da/dx.
        bend: (y, slope) -> d2a/dx2.
    """

    apply: Callable[[np.ndarray], object]
    slope: Callable[[np.ndarray], np.ndarray]
    bend: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _sigmoid(x: np.ndarray) -> None:
    np.multiply(x, 0.5, out=x)
    np.tanh(x, out=x)  # 1 / (1 + exp(-x)) without overflow
    x += 1.0
    x *= 0.5


def _elu(x: np.ndarray) -> None:
    below = np.expm1(np.minimum(x, 0.0))
    np.maximum(x, 0.0, out=x)
    x += below


def _softplus(x: np.ndarray) -> None:
    below = np.log1p(np.exp(-np.abs(x)))  # logaddexp warns of NaN
    np.maximum(x, 0.0, out=x)
    x += below


ACTIVATIONS = {
    "tanh": Activation(lambda x: np.tanh(x, out=x), lambda y: 1.0 - y * y, lambda y, slope: -2.0 * y * slope),
    "sigmoid": Activation(_sigmoid, lambda y: y * (1.0 - y), lambda y, slope: slope * (1.0 - 2.0 * y)),
    "relu": Activation(
        lambda x: np.maximum(x, 0.0, out=x), lambda y: (y > 0.0).astype(y.dtype), lambda y, slope: np.zeros_like(y)
    ),
    "elu": Activation(_elu, lambda y: np.minimum(y, 0.0) + 1.0, lambda y, slope: np.where(y > 0.0, 0.0, slope)),
    "softplus": Activation(_softplus, lambda y: -np.expm1(-y), lambda y, slope: slope * (1.0 - slope)),
}
"""A network can have these activations: name -> function."""


def check_activation(name: str) -> str:
    """Return the name of an activation.

    Raises:
        SchemaError: No activation has this name.
    """
    if name not in ACTIVATIONS:
        raise SchemaError(f"Activation '{name}' is not known. Known activations: {', '.join(ACTIVATIONS)}.")
    return name


class Layer(NamedTuple):
    """An affine map and the activation after it.

    Attributes:
        matrix: Shape (n_in, n_out).
        offset: Shape (n_out,).
        activation: Name of the activation.
        straight: Number of columns at the end of the output that have no activation.
    """

    matrix: np.ndarray
    offset: np.ndarray
    activation: str
    straight: int = 0

    @property
    def bent(self) -> int:
        """Number of columns of the output that have the activation; they come first."""
        return 0 if self.activation == LINEAR else len(self.offset) - self.straight

    def activate(self, x: np.ndarray) -> None:
        """Add the offset and apply the activation, shape (..., n_out), in place."""
        x += self.offset
        if self.bent:
            ACTIVATIONS[self.activation].apply(x[..., : self.bent])

    def slope(self, value: np.ndarray) -> np.ndarray:
        """Return da/dx at values after the layer, shape (samples, n_out)."""
        return self._filled(ACTIVATIONS[self.activation].slope(value[:, : self.bent]), value, 1.0)

    def bend(self, value: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return d2a/dx2 at values after the layer and their slope, shapes (samples, n_out)."""
        part = ACTIVATIONS[self.activation].bend(value[:, : self.bent], slope[:, : self.bent])
        return self._filled(part, value, 0.0)

    def _filled(self, part: np.ndarray, value: np.ndarray, rest: float) -> np.ndarray:
        whole = np.full(value.shape, rest, value.dtype)
        whole[:, : self.bent] = part
        return whole


Chain = tuple[Layer, ...]
Trace = list[np.ndarray]
"""A trace contains the input and the value after every layer, shapes (samples, n)."""


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
        """Return every matrix and offset, in the order of the layers."""
        return [array for layer in self.whole for array in (layer.matrix, layer.offset)]

    def replaced(self, arrays: list[np.ndarray]) -> "Weights":
        """Return the same network with other matrices and offsets, in the order of `arrays`."""
        pairs = zip(self.whole, arrays[::2], arrays[1::2], strict=True)
        layers = tuple(layer._replace(matrix=matrix, offset=offset) for layer, matrix, offset in pairs)
        return Weights(layers[: len(self.encoder)], layers[len(self.encoder) :])

    def astype(self, dtype: type) -> "Weights":
        """Return a copy in another precision (float64 for finite differences)."""
        return self.replaced([array.astype(dtype) for array in self.arrays()])


def run(chain: Chain, x: np.ndarray) -> np.ndarray:
    """Run forward, shape (n_in,) or (samples, n_in) -> (n_out,) or (samples, n_out)."""
    for layer in chain:
        x = x @ layer.matrix
        layer.activate(x)
    return x


def trace(chain: Chain, x: np.ndarray) -> Trace:
    """Run forward and return the values that the other passes need."""
    values = [x]
    for layer in chain:
        x = x @ layer.matrix
        layer.activate(x)
        values.append(x)
    return values


def pull(chain: Chain, values: Trace, gradient: np.ndarray) -> np.ndarray:
    """Propagate the gradient of a scalar from the output to the input, shapes (samples, n)."""
    for layer, value in zip(reversed(chain), reversed(values), strict=False):
        if layer.bent:
            gradient = gradient * layer.slope(value)
        gradient = gradient @ layer.matrix.T
    return gradient


def push(chain: Chain, values: Trace, tangent: np.ndarray) -> np.ndarray:
    """Propagate a change of the input to the output, to first order, shapes (samples, n)."""
    for layer, value in zip(chain, values[1:], strict=True):
        tangent = tangent @ layer.matrix
        if layer.bent:
            tangent *= layer.slope(value)
    return tangent


class Curvature:
    """First and mixed second derivatives of s = w . y(x): its gradient g = dy/dx^T w, then d(u . g)/dx for a fixed u.

    Forward over reverse mode: the tangent u is pushed forward through the network, and w . (dy/dx u) is pulled back.
    The second pull needs the same gradients at the layers as the pull that computed g, so they are stored.
    """

    __slots__ = ("_chain", "_gradients", "_slopes", "_values", "gradient")

    def __init__(self, chain: Chain, x: np.ndarray, w: np.ndarray) -> None:
        """Run forward at x, shape (samples, n_in), and pull w, shape (samples, n_out), back to `gradient`."""
        self._chain = chain
        self._values = trace(chain, x)
        self._slopes: list[np.ndarray | None] = []
        self._gradients: list[np.ndarray] = []
        gradient = w
        for layer, value in zip(reversed(chain), reversed(self._values), strict=False):
            slope = layer.slope(value) if layer.bent else None
            self._slopes.append(slope)
            self._gradients.append(gradient)
            gradient = (gradient if slope is None else gradient * slope) @ layer.matrix.T
        self._slopes.reverse()
        self._gradients.reverse()
        self.gradient = gradient

    def mixed(self, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return dy/dx u, shape (samples, n_out), and d(u . g)/dx, shape (samples, n_in), for a tangent u."""
        tangents: list[np.ndarray] = []
        for layer, slope in zip(self._chain, self._slopes, strict=True):
            tangent = tangent @ layer.matrix
            tangents.append(tangent)
            if slope is not None:
                tangent = tangent * slope
        second: np.ndarray | None = None
        for index in range(len(self._chain) - 1, -1, -1):
            slope = self._slopes[index]
            if slope is not None:
                bend = self._chain[index].bend(self._values[index + 1], slope)
                bend = bend * tangents[index] * self._gradients[index]
                second = bend if second is None else second * slope + bend
            if second is not None:
                second = second @ self._chain[index].matrix.T
        return tangent, np.zeros_like(self.gradient) if second is None else second
