"""Inference by a mask (paper, usages a and b) for one sample, from raw units to raw units."""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.chain import Packed, first, forward, space
from gemuco.compiled.jit import jit


class Predictor(NamedTuple):
    """A network with what stands around it.

    Attributes:
        chain: Encoder and decoder.
        inputs: Where x_in lies in the layout, shape (in_size,).
        outputs: Where x_out does, shape (out_size,).
        scale: Mean and standard deviation of every element [its unit], shape (2, size).
        clip: Inputs further from the mean than this [standard deviations] are taken for this far.
    """

    chain: Packed
    inputs: np.ndarray
    outputs: np.ndarray
    scale: np.ndarray
    clip: float


@jit
def infer(predictor, joined, through, tail):
    """What the network says of one sample.

    Args:
        predictor: The network.
        joined: Every element of the layout [its unit], shape (size,); NaN where masked.
        through: 1 for elements of x_in that the mask lets through, else 0, shape (in_size,).
        tail: m and p, shape (masks + bias_size,).

    Returns:
        Every element of x_out [its unit], NaN for others, shape (size,); and the root mean square of what was given
        minus what the network says of it [standard deviations], NaN if it says nothing.
    """
    values = space(predictor.chain, 1)
    inputs = first(predictor.chain, values, 1)[0]
    count = len(predictor.inputs)
    for i in range(count):
        inputs[i] = 0.0
        if through[i] > 0.0:
            element = predictor.inputs[i]
            x = (joined[element] - predictor.scale[0, element]) / predictor.scale[1, element]
            inputs[i] = min(max(x, -predictor.clip), predictor.clip)
    for i in range(len(tail)):
        inputs[count + i] = tail[i]
    told = forward(predictor.chain, values, 1)[0]
    found = np.full(len(joined), np.nan)
    square, given = 0.0, 0
    for i in range(len(predictor.outputs)):
        element = predictor.outputs[i]
        mean, std = predictor.scale[0, element], predictor.scale[1, element]
        found[element] = told[i] * std + mean
        if np.isfinite(joined[element]):
            amiss = told[i] - (joined[element] - mean) / std
            square += amiss * amiss
            given += 1
    return found, np.sqrt(square / given) if given else np.nan
