"""One gradient step on W and p (paper, usages c and d); see `gemuco.adaption.relearn` and `gemuco.optimiser`."""

import numpy as np

from gemuco.compiled.bend import slopes
from gemuco.compiled.blas import times_turned, turned_times
from gemuco.compiled.chain import CODE, NARROW, PLACE, WIDE, after, first, forward, matrix, space
from gemuco.compiled.jit import jit

MOMENTUM = 0.9
SQUARES = 0.999
SQUARED = np.float32(np.inf)
"""No miss is too large to count squared."""


@jit
def missed(told, wanted, straight, gradient):
    """Mean loss of what was told, and its derivatives by that into `gradient`.

    Args:
        told: Shape (rows, n_out).
        wanted: The same shape; NaN where nothing is known.
        straight: Misses above this count in proportion and no longer squared (Huber); infinite: all are squared.
        gradient: Shape (rows, n_out), or (0, 0) if nobody asks.
    """
    total, count = 0.0, 0
    for row in range(len(told)):
        for i in range(told.shape[1]):
            miss = told[row, i] - wanted[row, i]
            known = np.isfinite(wanted[row, i])
            bound = min(max(miss, -straight), straight) if known else np.float32(0.0)
            if known:
                total += bound * (miss + miss - bound)
                count += 1
            if len(gradient):
                gradient[row, i] = bound
    share = np.float32(2.0 / max(count, 1))
    for row in range(len(gradient)):
        for i in range(gradient.shape[1]):
            gradient[row, i] *= share
    return total / max(count, 1)


@jit
def loss(chain, inputs, wanted, straight):
    """Mean loss of a batch; see `missed`."""
    values = space(chain, len(inputs))
    first(chain, values, len(inputs))[:] = inputs
    told = forward(chain, values, len(inputs))
    return missed(told, wanted, straight, np.empty((0, 0), told.dtype))


@jit
def gradients(chain, inputs, wanted, straight, by_weights, by_inputs):
    """Mean loss of a batch, and its derivatives.

    Args:
        chain: The network.
        inputs: Shape (rows, n_in).
        wanted: Shape (rows, n_out); NaN where nothing is known.
        straight: See `missed`.
        by_weights: Whether derivatives by W are wanted.
        by_inputs: Whether derivatives by the inputs are.

    Returns:
        The loss, its gradient by W in the order of `chain.flat`, and by the inputs, shape (rows, n_in); empty where
        nobody wants it.
    """
    rows = len(inputs)
    values = space(chain, rows)
    first(chain, values, rows)[:] = inputs
    told = forward(chain, values, rows)
    gradient = np.empty_like(told)
    total = missed(told, wanted, straight, gradient)
    found = np.empty(len(chain.flat) if by_weights else 0, chain.flat.dtype)
    for layer in range(len(chain.form) - 1, -1, -1):
        code = chain.form[layer, CODE]
        if code:
            slopes(after(chain, values, rows, layer), gradient, code)
        wide, narrow = chain.form[layer, WIDE], chain.form[layer, NARROW]
        below = first(chain, values, rows) if layer == 0 else after(chain, values, rows, layer - 1)
        if by_weights:
            place = chain.form[layer, PLACE]
            turned_times(below, gradient, found[place : place + wide * narrow].reshape(wide, narrow))
            offsets = found[place + wide * narrow : place + (wide + 1) * narrow]
            offsets[:] = 0.0
            for row in range(rows):
                for i in range(narrow):
                    offsets[i] += gradient[row, i]
        pulled = np.empty((rows if layer or by_inputs else 0, wide), gradient.dtype)
        if len(pulled):
            times_turned(gradient, matrix(chain, layer), pulled)
        gradient = pulled
    return total, found, gradient


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
