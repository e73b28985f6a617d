"""Inference by a mask (paper, usages a and b) for one sample, from raw units to raw units."""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.chain import Packed, first, forward, space
from gemuco.compiled.jit import jit

Parts = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]
"""This is the type of `Predictor.parts`."""


class Predictor(NamedTuple):
    """A network, the positions of its inputs and outputs, and the scale of the signals.

    Attributes:
        chain: Encoder and decoder.
        inputs: Indices of x_in in the layout, shape (in_size,).
        outputs: Indices of x_out in the layout, shape (out_size,).
        scale: Mean and standard deviation of every element [its unit], shape (2, size).
        clip: Largest distance of inputs from the mean [standard deviations]; larger ones are clipped to it.
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
def infer(flat, form, inputs, outputs, scale, clip, joined, through, path, tail, direct, requested, estimate):
    """Predict one sample under a mask.

    The predictor is passed in `parts`, because Python passes arrays in half the time of tuples of arrays.

    Args:
        flat: See `Packed`.
        form: See `Packed`.
        inputs: See `Predictor`.
        outputs: See `Predictor`.
        scale: See `Predictor`.
        clip: See `Predictor`.
        joined: Every element of the layout [its unit], shape (size,); NaN where masked.
        through: 1 for elements of x_in that the mask lets through, else 0, shape (in_size,).
        path: Regression of the code l, shape (in_size + 1, width).
        tail: m and p, shape (masks + bias_size,).
        direct: Part of the linear path in x_out, shape (in_size + 2, out_size).
        requested: Whether each element is requested, truth values, shape (size,).
        estimate: Result for the requested elements [its unit], shape (size,); NaN for elements that are not in x_out.

    Returns:
        Root mean square of the difference between the sample and its prediction [standard deviations], NaN if no
        element of x_out was given; and the same of the elements that the mask lets through.
    """
    chain = Packed(flat, form)
    values = space(chain, 1)
    line = first(chain, values, 1)[0]
    inside = np.zeros(len(joined), np.bool_)
    count, width = len(inputs), path.shape[1]
    given = np.zeros(count)
    for k in range(width):
        line[count + k] = path[count, k]
    for i in range(count):
        line[i] = 0.0
        if through[i] > 0.0:
            element = inputs[i]
            inside[element] = True
            x = (joined[element] - scale[0, element]) / scale[1, element]
            given[i] = x
            line[i] = min(max(x, -clip), clip)
            for k in range(width):
                line[count + k] += x * path[i, k]
    for i in range(len(tail)):
        line[count + width + i] = tail[i]
    prediction = forward(chain, values, 1)[0]
    for i in range(len(estimate)):
        if requested[i]:
            estimate[i] = np.nan
    for i in range(len(outputs)):
        share = direct[count + 1, i]
        if share < 1.0:
            prediction[i] = share * prediction[i] + direct[count, i]
            for k in range(count):
                prediction[i] += given[k] * direct[k, i]
    square, known, own, members = 0.0, 0, 0.0, 0
    for i in range(len(outputs)):
        element = outputs[i]
        mean, std = scale[0, element], scale[1, element]
        if requested[element]:
            estimate[element] = prediction[i] * std + mean
        if np.isfinite(joined[element]):
            residual = prediction[i] - (joined[element] - mean) / std
            square += residual * residual
            known += 1
            if inside[element]:
                own += residual * residual
                members += 1
    return np.sqrt(square / known) if known else np.nan, np.sqrt(own / members) if members else np.nan
