"""Inference by a mask (paper, usages a and b) for one sample, from raw units to raw units."""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.chain import Packed, first, forward, space
from gemuco.compiled.jit import jit

Parts = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]
"""`Predictor.parts`"""


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

    @property
    def parts(self) -> Parts:
        """The arrays one by one, as `infer` takes them."""
        return (*self.chain, self.inputs, self.outputs, self.scale, self.clip)


@jit
def infer(flat, form, inputs, outputs, scale, clip, joined, through, tail, wanted, found):
    """What the network says of one sample.

    The predictor comes in its `parts`: Python hands arrays over in half the time that it needs for tuples of them.

    Args:
        flat: See `Packed`.
        form: See `Packed`.
        inputs: See `Predictor`, and so for the next three.
        outputs: See there.
        scale: See there.
        clip: See there.
        joined: Every element of the layout [its unit], shape (size,); NaN where masked.
        through: 1 for elements of x_in that the mask lets through, else 0, shape (in_size,).
        tail: m and p, shape (masks + bias_size,).
        wanted: Which elements are asked for, truth values, shape (size,).
        found: What is told of those [its unit] is written into it, shape (size,); NaN for what is not in x_out.

    Returns:
        The root mean square of what was given minus what the network says of it [standard deviations], NaN if it says
        nothing.
    """
    chain = Packed(flat, form)
    values = space(chain, 1)
    line = first(chain, values, 1)[0]
    count = len(inputs)
    for i in range(count):
        line[i] = 0.0
        if through[i] > 0.0:
            element = inputs[i]
            x = (joined[element] - scale[0, element]) / scale[1, element]
            line[i] = min(max(x, -clip), clip)
    for i in range(len(tail)):
        line[count + i] = tail[i]
    told = forward(chain, values, 1)[0]
    for i in range(len(found)):
        if wanted[i]:
            found[i] = np.nan
    square, given = 0.0, 0
    for i in range(len(outputs)):
        element = outputs[i]
        mean, std = scale[0, element], scale[1, element]
        if wanted[element]:
            found[element] = told[i] * std + mean
        if np.isfinite(joined[element]):
            amiss = told[i] - (joined[element] - mean) / std
            square += amiss * amiss
            given += 1
    return np.sqrt(square / given) if given else np.nan
