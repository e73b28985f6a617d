"""One network under many masks: its squared errors on the same rows; see `gemuco.mask_errors`.

What a mask keeps back is left out of the first layer's matrix in place of the rows, and its bits are added to the
offset, so nothing of a row's size is copied. Rows go in blocks whose values stay in the second-level cache.
"""

import numpy as np

from gemuco.compiled.bend import bend
from gemuco.compiled.blas import times
from gemuco.compiled.chain import CODE, NARROW, matrix, offset
from gemuco.compiled.jit import jit

BLOCK = 256
"""Rows at a time, at most: of smaller blocks a product has less, larger ones leave the cache (benchmarks.learning)."""


@jit
def begin(chain, gate, bits, start, shift):
    """The first layer under one mask: its matrix for elements and p into `start`, and its offset into `shift`.

    Args:
        chain: The network: elements, bits and p in.
        gate: 1 for elements that the mask lets through, else 0, shape (size,).
        bits: The mask, shape (signals,).
        start: Shape (size + bias_size, n_out).
        shift: Shape (n_out,).
    """
    whole, plain = matrix(chain, 0), offset(chain, 0)
    size, signals, width = len(gate), len(bits), len(shift)
    for k in range(width):
        shift[k] = plain[k]
    for i in range(signals):
        if bits[i] > 0.0:
            for k in range(width):
                shift[k] += whole[size + i, k]
    for i in range(size):
        for k in range(width):
            start[i, k] = whole[i, k] * gate[i]
    for i in range(size, len(start)):
        for k in range(width):
            start[i, k] = whole[signals + i, k]


@jit
def told(chain, rows, start, shift, one, other):
    """What the network tells of a block of rows, shape (rows, n_out), a part of one of the two spaces."""
    count = len(rows)
    value = rows
    for layer in range(len(chain.form)):
        width = chain.form[layer, NARROW]
        result = one[: count * width].reshape(count, width)
        if layer == 0:
            times(value, start, result)
            bend(result, shift, chain.form[0, CODE])
        else:
            times(value, matrix(chain, layer), result)
            bend(result, offset(chain, layer), chain.form[layer, CODE])
        value = result
        one, other = other, one
    return value


@jit
def widest(chain):
    """The most values that a layer has."""
    width = 0
    for layer in range(len(chain.form)):
        width = max(width, chain.form[layer, NARROW])
    return width


@jit
def usable(whole, bits, row):
    """Whether a row has all signals of a mask."""
    has_all = True
    for i in range(len(bits)):
        has_all &= whole[row, i] or bits[i] == 0.0
    return has_all


@jit
def sums(chain, rows, wanted, known, whole, gates, masks):
    """Sum of squared errors of every element under every mask, shape (masks, size).

    Args:
        chain: The network.
        rows: Elements, gaps filled, and p, shape (rows, size + bias_size).
        wanted: Shape (rows, size), gaps filled.
        known: 1 for elements that count, else 0, shape (rows, size).
        whole: Which signals are whole, shape (rows, signals): a mask is tried where all of its are.
        gates: 1 for elements that a mask lets through, else 0, shape (masks, size).
        masks: 1 for the signals of a mask, else 0, shape (masks, signals).
    """
    size, width = wanted.shape[1], widest(chain)
    block = -(-len(rows) // max(1, -(-len(rows) // BLOCK)))
    one, other = np.empty(block * width, rows.dtype), np.empty(block * width, rows.dtype)
    start = np.empty((rows.shape[1], chain.form[0, NARROW]), rows.dtype)
    shift = np.empty(chain.form[0, NARROW], rows.dtype)
    part, squared = np.empty(size, rows.dtype), np.zeros((len(masks), size))
    for index in range(len(masks)):
        begin(chain, gates[index], masks[index], start, shift)
        for piece in range(0, len(rows), block):
            found = told(chain, rows[piece : piece + block], start, shift, one, other)
            part[:] = 0.0
            for row in range(len(found)):
                if usable(whole, masks[index], piece + row):
                    line, aim, counts = found[row], wanted[piece + row], known[piece + row]
                    for i in range(size):
                        miss = line[i] - aim[i]
                        part[i] += counts[i] * miss * miss
            for i in range(size):
                squared[index, i] += part[i]
    return squared


@jit
def squares(chain, rows, wanted, known, whole, gates, masks):
    """Squared error of every element of every row under every mask, shape (masks, rows, size); see `sums`.

    It is 0 where a row has not all signals of a mask, or an element does not count.
    """
    width = widest(chain)
    one, other = np.empty(len(rows) * width, rows.dtype), np.empty(len(rows) * width, rows.dtype)
    start = np.empty((rows.shape[1], chain.form[0, NARROW]), rows.dtype)
    shift = np.empty(chain.form[0, NARROW], rows.dtype)
    squared = np.zeros((len(masks), len(rows), wanted.shape[1]), rows.dtype)
    for index in range(len(masks)):
        begin(chain, gates[index], masks[index], start, shift)
        found = told(chain, rows, start, shift, one, other)
        for row in range(len(found)):
            if usable(whole, masks[index], row):
                line, aim, counts, out = found[row], wanted[row], known[row], squared[index, row]
                for i in range(len(out)):
                    miss = line[i] - aim[i]
                    out[i] = counts[i] * miss * miss
    return squared
