"""Prediction errors under several masks, and their derivatives by p (`gemuco.adaption.innovation`)."""

import numpy as np

from gemuco.compiled.bend import bend, slopes
from gemuco.compiled.blas import times, times_turned_double
from gemuco.compiled.chain import BENT, CODE, NARROW, matrix, offset
from gemuco.compiled.jit import jit


@jit
def innovations(predictor, rows, biases, through, paths, tails, directs, index, whiten):
    """Return the whitened errors of samples under several masks, and derivatives: error(p + dp) = error - slope dp.

    Args:
        predictor: The network (`inference.Predictor`).
        rows: Samples [standard deviations], shape (rows, size), or (1, size) for all p.
        biases: p of every row, shape (rows, bias_size).
        through: 1 for elements of x_in that each mask lets through, else 0, shape (masks, in_size).
        paths: Regression of the code l under each mask, shape (masks, in_size + 1, width).
        tails: m of each mask, followed by any p, shape (masks, x_in signals + bias_size).
        directs: Part of the linear path in x_out under each mask, shape (masks, in_size + 2, out_size).
        index: Positions of the errors in the flattened (masks, out_size) table, shape (n,).
        whiten: Matrix that converts the errors to independent ones of variance 1, shape (n, n).

    Returns:
        Errors, shape (rows, n), and derivatives, shape (rows, n, bias_size).
    """
    count, size = biases.shape
    masks, outputs = len(through), len(predictor.outputs)
    batch = count * masks
    prediction = values_and_tangents(predictor, rows, biases, through, paths, tails)
    mix(predictor, rows, prediction, count, through, directs)
    raw = np.empty((count * (1 + size), len(index)))
    for row in range(count):
        sample = rows[row if len(rows) > 1 else 0]
        for i in range(len(index)):
            line, element = row * masks + index[i] // outputs, index[i] % outputs
            raw[row, i] = sample[predictor.outputs[element]] - prediction[line, element]
            for j in range(size):
                raw[count + row * size + j, i] = prediction[(1 + j) * batch + line, element]
    white = np.empty_like(raw)
    if len(index):
        times_turned_double(raw, whiten, white)
    slope = np.empty((count, len(index), size))
    for row in range(count):
        for j in range(size):
            for i in range(len(index)):
                slope[row, i, j] = white[count + row * size + j, i]
    return white[:count], slope


@jit
def mix(predictor, rows, prediction, count, through, directs):
    """Mix the network's outputs and derivatives with the linear path in place; see `innovations`."""
    masks, wide = through.shape
    for m in range(masks):
        for i in range(prediction.shape[1]):
            share = directs[m, wide + 1, i]
            if share < 1.0:
                for line in range(m, len(prediction), masks):
                    prediction[line, i] *= share
                for row in range(count):
                    sample, line = rows[row if len(rows) > 1 else 0], directs[m, wide, i]
                    for k in range(wide):
                        if through[m, k] > 0.0:
                            line += sample[predictor.inputs[k]] * directs[m, k, i]
                    prediction[row * masks + m, i] += line


@jit
def values_and_tangents(predictor, rows, biases, through, paths, tails):
    """Return the network's output for every row under every mask, followed by its derivatives by each element of p.

    Both pass a layer in one product, so that each matrix is read once.

    Returns:
        Outputs and derivatives, shape ((1 + bias_size) * rows * masks, out_size).
    """
    chain, (count, size) = predictor.chain, biases.shape
    masks, wide = through.shape
    batch, width, code = count * masks, tails.shape[1], paths.shape[2]
    begin = matrix(chain, 0)
    inputs = np.empty((batch, len(begin)), begin.dtype)
    for row in range(count):
        sample = rows[row if len(rows) > 1 else 0]
        for m in range(masks):
            line = inputs[row * masks + m]
            for k in range(code):
                line[wide + k] = paths[m, wide, k]
            for i in range(wide):
                line[i] = 0.0
                if through[m, i] > 0.0:
                    x = sample[predictor.inputs[i]]
                    line[i] = min(max(x, -predictor.clip), predictor.clip)
                    for k in range(code):
                        line[wide + k] += x * paths[m, i, k]
            for i in range(width - size):
                line[wide + code + i] = tails[m, i]
            for i in range(size):
                line[wide + code + width - size + i] = biases[row, i]
    value = np.empty(((1 + size) * batch, begin.shape[1]), begin.dtype)
    times(inputs, begin, value[:batch])
    for j in range(size):
        for row in range(batch):
            for i in range(value.shape[1]):
                value[(1 + j) * batch + row, i] = begin[len(begin) - size + j, i]
    for layer in range(len(chain.form)):
        if layer:
            above = np.empty((len(value), chain.form[layer, NARROW]), value.dtype)
            times(value, matrix(chain, layer), above)
            value = above
        kind, bent = chain.form[layer, CODE], chain.form[layer, BENT]
        bend(value[:batch], offset(chain, layer), kind, bent)
        if kind:
            for j in range(size):
                slopes(value[:batch], value[(1 + j) * batch : (2 + j) * batch], kind, bent)
    return value
