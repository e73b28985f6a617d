"""Errors of everything that was predicted from other signals, and how p moves them (`gemuco.adaption.innovation`)."""

import numpy as np

from gemuco.compiled.bend import bend, slopes
from gemuco.compiled.blas import times, times_turned_double
from gemuco.compiled.chain import CODE, NARROW, matrix, offset
from gemuco.compiled.jit import jit


@jit
def innovations(predictor, rows, biases, through, tails, index, whiten):
    """Whitened errors of samples under several masks and p, and their derivatives: error(p + dp) = error - slope dp.

    Args:
        predictor: The network (`inference.Predictor`).
        rows: Samples [standard deviations], shape (rows, size), or (1, size) for all p.
        biases: p of every row, shape (rows, bias_size).
        through: 1 for elements of x_in that each mask lets through, else 0, shape (masks, in_size).
        tails: m of each mask, with any p behind it, shape (masks, x_in signals + bias_size).
        index: Which errors: positions in the (masks, out_size) table, flattened, shape (n,).
        whiten: Turns errors into independent ones of variance 1, shape (n, n).

    Returns:
        Errors, shape (rows, n), and derivatives, shape (rows, n, bias_size).
    """
    count, size = biases.shape
    masks, outputs = len(through), len(predictor.outputs)
    batch = count * masks
    told = values_and_tangents(predictor, rows, biases, through, tails)
    raw = np.empty((count * (1 + size), len(index)))
    for row in range(count):
        sample = rows[row if len(rows) > 1 else 0]
        for i in range(len(index)):
            line, element = row * masks + index[i] // outputs, index[i] % outputs
            raw[row, i] = sample[predictor.outputs[element]] - told[line, element]
            for j in range(size):
                raw[count + row * size + j, i] = told[(1 + j) * batch + line, element]
    turned = np.empty_like(raw)
    if len(index):
        times_turned_double(raw, whiten, turned)
    found = np.empty((count, len(index), size))
    for row in range(count):
        for j in range(size):
            for i in range(len(index)):
                found[row, i, j] = turned[count + row * size + j, i]
    return turned[:count], found


@jit
def values_and_tangents(predictor, rows, biases, through, tails):
    """The network's output for every row under every mask, and below how it moves with each element of p.

    Both go through a layer in one product: a matrix is read once for all of them.

    Returns:
        Shape ((1 + bias_size) * rows * masks, out_size).
    """
    chain, (count, size) = predictor.chain, biases.shape
    masks, wide = through.shape
    batch, width = count * masks, tails.shape[1]
    begin = matrix(chain, 0)
    inputs = np.empty((batch, len(begin)), begin.dtype)
    for row in range(count):
        sample = rows[row if len(rows) > 1 else 0]
        for m in range(masks):
            line = inputs[row * masks + m]
            for i in range(wide):
                line[i] = 0.0
                if through[m, i] > 0.0:
                    line[i] = min(max(sample[predictor.inputs[i]], -predictor.clip), predictor.clip)
            for i in range(width - size):
                line[wide + i] = tails[m, i]
            for i in range(size):
                line[wide + width - size + i] = biases[row, i]
    told = np.empty(((1 + size) * batch, begin.shape[1]), begin.dtype)
    times(inputs, begin, told[:batch])
    for j in range(size):
        for row in range(batch):
            for i in range(told.shape[1]):
                told[(1 + j) * batch + row, i] = begin[len(begin) - size + j, i]
    for layer in range(len(chain.form)):
        if layer:
            above = np.empty((len(told), chain.form[layer, NARROW]), told.dtype)
            times(told, matrix(chain, layer), above)
            told = above
        code = chain.form[layer, CODE]
        bend(told[:batch], offset(chain, layer), code)
        if code:
            for j in range(size):
                slopes(told[:batch], told[(1 + j) * batch : (2 + j) * batch], code)
    return told
