"""The first weights of a training: those of torch's linear layers with the same seed, drawn without torch."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gemuco.layers import LINEAR, Chain, Layer, Weights, check_activation

DIGITS = 24
"""A number is drawn from this many random bits, as many as a float32 keeps."""


def first_weights(seed: int, inputs: int, outputs: int, hidden: Sequence[int], latent: int, activation: str) -> Weights:
    """Draw W: every weight and offset is uniform within 1 / sqrt(inputs of its layer).

    Args:
        seed: Seed of the numbers; its lowest 32 bits count.
        inputs: Length of x_in, m and p together.
        outputs: Length of x_out.
        hidden: Widths from the input to the latent state; the decoder mirrors them.
        latent: Length of z.
        activation: Name of the activation between the layers; latent state and output are linear.
    """
    random = np.random.RandomState(seed % 2**32)  # the generator of torch on a CPU
    check_activation(activation)
    encoder = _chain(random, [inputs, *hidden, latent], activation)
    return Weights(encoder, _chain(random, [latent, *reversed(hidden), outputs], activation))


def _chain(random: np.random.RandomState, sizes: Sequence[int], activation: str) -> Chain:
    layers = []
    for wide, narrow in pairwise(sizes):
        matrix = _uniform(random, wide, narrow * wide).reshape(narrow, wide).T.copy()
        layers.append(Layer(matrix, _uniform(random, wide, narrow), activation))
    return (*layers[:-1], layers[-1]._replace(activation=LINEAR))


def _uniform(random: np.random.RandomState, inputs: int, count: int) -> np.ndarray:
    """Return numbers of a layer with this number of inputs, shape (count,), float32."""
    low = -np.float32(1.0 / math.sqrt(inputs))
    share = (random.randint(0, 2**32, count, np.uint32) % 2**DIGITS) / 2.0**DIGITS
    return (share * float(-2.0 * low) + float(low)).astype(np.float32)  # rounded once, as torch does


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
