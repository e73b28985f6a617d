"""What bends a layer. Slope and bend are told from the value alone, so that a trace need keep nothing but values.

Only monotone functions can be told so; those that are not (SiLU, GELU) would need the argument too.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gemuco.errors import SchemaError

LINEAR = "linear"
"""The name of a layer that is not bent: the latent state and the output."""


class Activation(NamedTuple):
    """A function y = a(x), element by element.

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
    below = np.log1p(np.exp(-np.abs(x)))  # logaddexp warns of every missing sample
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
"""Every function a network can be bent by."""


def check(name: str) -> str:
    """The name, if it is one of an activation.

    Raises:
        SchemaError: It is not.
    """
    if name not in ACTIVATIONS:
        raise SchemaError(f"Activation '{name}' is not known. Known activations: {', '.join(ACTIVATIONS)}.")
    return name
