"""One gradient step on W and p (paper, usages c and d); see `gemuco.relearn` and `gemuco.optimiser`."""

import numpy as np

from gemuco.compiled.bend import slopes
from gemuco.compiled.blas import times_turned, turned_times
from gemuco.compiled.chain import CODE, NARROW, PLACE, WIDE, after, first, forward, matrix, space
from gemuco.compiled.jit import jit

MOMENTUM = 0.9
SQUARES = 0.999


@jit
def gradients(chain, inputs, wanted, weights):
    """Mean squared error of a batch, and its derivatives.

    Args:
        chain: The network.
        inputs: Shape (rows, n_in).
        wanted: Shape (rows, n_out); NaN where nothing is known.
        weights: Whether derivatives by W are wanted.

    Returns:
        The error, its gradient by W in the order of `chain.flat`, and by the inputs, shape (rows, n_in).
    """
    rows = len(inputs)
    values = space(chain, rows)
    begin = first(chain, values, rows)
    for row in range(rows):
        for i in range(inputs.shape[1]):
            begin[row, i] = inputs[row, i]
    told = forward(chain, values, rows)
    gradient = np.zeros_like(told)
    total, count = 0.0, 0
    for row in range(rows):
        for i in range(told.shape[1]):
            if np.isfinite(wanted[row, i]):
                gradient[row, i] = told[row, i] - wanted[row, i]
                total += gradient[row, i] * gradient[row, i]
                count += 1
    share = 2.0 / max(count, 1)
    for row in range(rows):
        for i in range(told.shape[1]):
            gradient[row, i] *= share
    found = np.zeros(len(chain.flat) if weights else 0, chain.flat.dtype)
    for layer in range(len(chain.form) - 1, -1, -1):
        code = chain.form[layer, CODE]
        if code:
            slopes(after(chain, values, rows, layer), gradient, code)
        wide, narrow = chain.form[layer, WIDE], chain.form[layer, NARROW]
        below = first(chain, values, rows) if layer == 0 else after(chain, values, rows, layer - 1)
        if weights:
            place = chain.form[layer, PLACE]
            turned_times(below, gradient, found[place : place + wide * narrow].reshape(wide, narrow))
            offsets = found[place + wide * narrow : place + (wide + 1) * narrow]
            for row in range(rows):
                for i in range(narrow):
                    offsets[i] += gradient[row, i]
        pulled = np.empty((rows, wide), gradient.dtype)
        times_turned(gradient, matrix(chain, layer), pulled)
        gradient = pulled
    return total / max(count, 1), found, gradient


@jit
def adam(numbers, gradient, slow, square, rate, time):
    """The `time`-th step of Adam in place, all shapes (n,)."""
    gain = rate * np.sqrt(1.0 - SQUARES**time) / (1.0 - MOMENTUM**time)
    fast, faster, step = np.float32(1.0 - MOMENTUM), np.float32(1.0 - SQUARES), np.float32(gain)
    for i in range(len(numbers)):
        slow[i] += fast * (gradient[i] - slow[i])
        square[i] += faster * (gradient[i] * gradient[i] - square[i])
        numbers[i] -= step * slow[i] / (np.sqrt(square[i]) + np.float32(1e-8))


@jit
def momentum(numbers, gradient, slow, rate):
    """A step of descent with momentum in place, all shapes (n,)."""
    keep, step = np.float32(MOMENTUM), np.float32(rate)
    for i in range(len(numbers)):
        slow[i] = keep * slow[i] + gradient[i]
        numbers[i] -= step * slow[i]
