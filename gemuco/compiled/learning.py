"""Gradients of W and p (paper, usages c and d) and steps; see `gemuco.adaption.relearn` and `gemuco.optimiser`."""

import numpy as np

from gemuco.compiled.bend import slopes
from gemuco.compiled.blas import times_turned, turned_times
from gemuco.compiled.chain import BENT, CODE, NARROW, PLACE, WIDE, after, first, forward, matrix, space
from gemuco.compiled.jit import jit

MOMENTUM = 0.9
SQUARES = 0.999
SQUARED = np.float32(np.inf)
"""With this bend every error counts squared."""
EQUAL = np.empty((0, 0), np.float32)
"""With these weights every error counts alike."""


@jit
def huber(prediction, target, weight, bend, gradient):
    """Return the mean loss of a prediction, and write its derivatives by the prediction into `gradient`.

    Args:
        prediction: Outputs of the network, shape (rows, n_out).
        target: Known outputs, shape (rows, n_out), NaN where not known.
        weight: Weight of every loss, shape (rows, n_out), or `EQUAL`.
        bend: Errors above this count linearly instead of squared (Huber); infinite: all are squared.
        gradient: Result, shape (rows, n_out), or (0, 0) if it is not needed.
    """
    total, count = 0.0, 0
    for row in range(len(prediction)):
        for i in range(prediction.shape[1]):
            error = prediction[row, i] - target[row, i]
            known = np.isfinite(target[row, i])
            bound = min(max(error, -bend), bend) if known else np.float32(0.0)
            counts = weight[row, i] if len(weight) else np.float32(1.0)
            if known:
                total += counts * bound * (error + error - bound)
                count += 1
            if len(gradient):
                gradient[row, i] = counts * bound
    share = np.float32(2.0 / max(count, 1))
    for row in range(len(gradient)):
        for i in range(gradient.shape[1]):
            gradient[row, i] *= share
    return total / max(count, 1)


@jit
def loss(chain, inputs, target, weight, bend):
    """Return the mean loss of a batch; see `huber`."""
    values = space(chain, len(inputs))
    first(chain, values, len(inputs))[:] = inputs
    prediction = forward(chain, values, len(inputs))
    return huber(prediction, target, weight, bend, np.empty((0, 0), prediction.dtype))


@jit
def gradients(chain, inputs, target, weight, bend, by_weights, by_inputs):
    """Return the mean loss of a batch, and its derivatives.

    Args:
        chain: The network.
        inputs: Inputs, shape (rows, n_in).
        target: Known outputs, shape (rows, n_out), NaN where not known.
        weight: See `huber`.
        bend: See `huber`.
        by_weights: Whether derivatives by W are computed.
        by_inputs: Whether derivatives by the inputs are computed.

    Returns:
        The loss, its gradient by W in the order of `chain.flat`, and its gradient by the inputs, shape (rows, n_in).
        A gradient that is not computed is empty.
    """
    rows = len(inputs)
    values = space(chain, rows)
    first(chain, values, rows)[:] = inputs
    prediction = forward(chain, values, rows)
    gradient = np.empty_like(prediction)
    total = huber(prediction, target, weight, bend, gradient)
    slope = np.empty(len(chain.flat) if by_weights else 0, chain.flat.dtype)
    for layer in range(len(chain.form) - 1, -1, -1):
        code = chain.form[layer, CODE]
        if code:
            slopes(after(chain, values, rows, layer), gradient, code, chain.form[layer, BENT])
        wide, narrow = chain.form[layer, WIDE], chain.form[layer, NARROW]
        below = first(chain, values, rows) if layer == 0 else after(chain, values, rows, layer - 1)
        if by_weights:
            place = chain.form[layer, PLACE]
            turned_times(below, gradient, slope[place : place + wide * narrow].reshape(wide, narrow))
            offsets = slope[place + wide * narrow : place + (wide + 1) * narrow]
            offsets[:] = 0.0
            for row in range(rows):
                for i in range(narrow):
                    offsets[i] += gradient[row, i]
        pulled = np.empty((rows if layer or by_inputs else 0, wide), gradient.dtype)
        if len(pulled):
            times_turned(gradient, matrix(chain, layer), pulled)
        gradient = pulled
    return total, slope, gradient


@jit
def adam(numbers, gradient, slow, square, rate, time):
    """Do step number `time` of Adam in place, all shapes (n,)."""
    gain = rate * np.sqrt(1.0 - SQUARES**time) / (1.0 - MOMENTUM**time)
    fast, faster, step = np.float32(1.0 - MOMENTUM), np.float32(1.0 - SQUARES), np.float32(gain)
    for i in range(len(numbers)):
        slow[i] += fast * (gradient[i] - slow[i])
        square[i] += faster * (gradient[i] * gradient[i] - square[i])
        numbers[i] -= step * slow[i] / (np.sqrt(square[i]) + np.float32(1e-8))


@jit
def momentum(numbers, gradient, slow, rate):
    """Do one step of descent with momentum in place, all shapes (n,)."""
    keep, step = np.float32(MOMENTUM), np.float32(rate)
    for i in range(len(numbers)):
        slow[i] = keep * slow[i] + gradient[i]
        numbers[i] -= step * slow[i]
