"""Errors of everything that was predicted without being told, and how p moves them; see `gemuco.innovation`."""

import numpy as np

from gemuco.compiled.bend import slopes
from gemuco.compiled.blas import times
from gemuco.compiled.chain import CODE, NARROW, after, first, forward, matrix, space
from gemuco.compiled.jit import jit


@jit
def innovations(predictor, rows, biases, through, tails, index, whiten):
    """Whitened errors of samples under several masks and p, and their derivatives: error(p + dp) = error - slope dp.

    Args:
        predictor: The network (`inference.Predictor`).
        rows: Samples [standard deviations], shape (rows, size).
        biases: p of every row, shape (rows, bias_size).
        through: 1 for elements of x_in that each mask lets through, else 0, shape (masks, in_size).
        tails: m of each mask, with any p behind it, shape (masks, x_in signals + bias_size).
        index: Which errors: positions in the (masks, out_size) table, flattened, shape (n,).
        whiten: Turns errors into independent ones of variance 1, shape (n, n).

    Returns:
        Errors, shape (rows, n), and derivatives, shape (rows, n, bias_size).
    """
    chain = predictor.chain
    count, size = biases.shape
    masks, wide = through.shape
    batch, width = count * masks, tails.shape[1]
    values = space(chain, batch)
    inputs = first(chain, values, batch)
    for row in range(count):
        for m in range(masks):
            line = inputs[row * masks + m]
            for i in range(wide):
                line[i] = 0.0
                if through[m, i] > 0.0:
                    line[i] = min(max(rows[row, predictor.inputs[i]], -predictor.clip), predictor.clip)
            for i in range(width - size):
                line[wide + i] = tails[m, i]
            for i in range(size):
                line[wide + width - size + i] = biases[row, i]
    told = forward(chain, values, batch)
    moved = tangents(chain, values, batch, size)
    outputs = len(predictor.outputs)
    raw, slope = np.empty((count, len(index))), np.empty((count * size, len(index)))
    for row in range(count):
        for i in range(len(index)):
            line, element = row * masks + index[i] // outputs, index[i] % outputs
            raw[row, i] = rows[row, predictor.outputs[element]] - told[line, element]
            for j in range(size):
                slope[row * size + j, i] = moved[j * batch + line, element]
    errors, turned = np.empty_like(raw), np.empty_like(slope)
    np.dot(raw, whiten.T, errors)
    np.dot(slope, whiten.T, turned)
    found = np.empty((count, len(index), size))
    for row in range(count):
        for j in range(size):
            for i in range(len(index)):
                found[row, i, j] = turned[row * size + j, i]
    return errors, found


@jit
def tangents(chain, values, batch, size):
    """How the output of every row moves with each of the last `size` inputs, shape (size * rows, n_out)."""
    begin = matrix(chain, 0)
    moved = np.empty((size * batch, chain.form[0, NARROW]), values.dtype)
    for j in range(size):
        for row in range(batch):
            for i in range(moved.shape[1]):
                moved[j * batch + row, i] = begin[len(begin) - size + j, i]
    for layer in range(len(chain.form)):
        if layer:
            above = np.empty((size * batch, chain.form[layer, NARROW]), values.dtype)
            times(moved, matrix(chain, layer), above)
            moved = above
        code = chain.form[layer, CODE]
        if code:
            for j in range(size):
                slopes(after(chain, values, batch, layer), moved[j * batch : (j + 1) * batch], code)
    return moved
