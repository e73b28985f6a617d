"""One network under many masks: its squared errors on the same rows; see `gemuco.mask_errors`.

What a mask keeps back is left out of the rows and of the first layer's matrix, and its bits are added to the offset.
Rows go in blocks whose values stay in the second-level cache.
"""

import numpy as np

from gemuco.compiled.bend import bend
from gemuco.compiled.blas import times
from gemuco.compiled.chain import CODE, NARROW, matrix, offset
from gemuco.compiled.jit import jit

BLOCK = 256
"""Rows at a time, at most: of smaller blocks a product has less, larger ones leave the cache (benchmarks.learning)."""


@jit
def begin(chain, gate, bits, chosen, start, shift):
    """The first layer under one mask: its matrix for what the mask lets through into `start`, its offset into `shift`.

    Args:
        chain: The network: elements, bits and p in.
        gate: 1 for elements that the mask lets through, else 0, shape (size,).
        bits: The mask, shape (signals,).
        chosen: Which columns of the rows go in, the elements that are let through and p; shape (size + bias_size,).
        start: Shape (size + bias_size, n_out).
        shift: Shape (n_out,).

    Returns:
        How many columns go in: what lies behind them in `chosen` and `start` is of no use.
    """
    whole, plain = matrix(chain, 0), offset(chain, 0)
    size, signals, width, count = len(gate), len(bits), len(shift), 0
    shift[:] = plain[:width]
    for i in range(signals):
        if bits[i] > 0.0:
            for k in range(width):
                shift[k] += whole[size + i, k]
    for i in range(len(start)):
        if i >= size or gate[i] > 0.0:
            chosen[count] = i
            start[count] = whole[i if i < size else i + signals]
            count += 1
    return count


@jit
def first(chain, rows, chosen, start, shift, given, out):
    """What the first layer makes of rows under the mask of `begin`, shape (rows, n_out); `given` has room for them."""
    part = given[: len(rows) * len(chosen)].reshape(len(rows), len(chosen))
    for row in range(len(rows)):
        line, target = rows[row], part[row]
        for i in range(len(chosen)):
            target[i] = line[chosen[i]]
    times(part, start, out)
    bend(out, shift, chain.form[0, CODE])


@jit
def told(chain, value, one, other):
    """What the other layers make of the first one's values, in `other`; shape (rows, n_out), in one of both."""
    count = len(value)
    for layer in range(1, len(chain.form)):
        width = chain.form[layer, NARROW]
        result = one[: count * width].reshape(count, width)
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
    size, width, narrow = wanted.shape[1], widest(chain), chain.form[0, NARROW]
    block = -(-len(rows) // max(1, -(-len(rows) // BLOCK)))
    one, other = np.empty(block * width, rows.dtype), np.empty(block * width, rows.dtype)
    start, shift = np.empty((rows.shape[1], narrow), rows.dtype), np.empty(narrow, rows.dtype)
    chosen, given = np.empty(rows.shape[1], np.int64), np.empty(block * rows.shape[1], rows.dtype)
    part, squared = np.empty(size, rows.dtype), np.zeros((len(masks), size))
    for index in range(len(masks)):
        count = begin(chain, gates[index], masks[index], chosen, start, shift)
        for piece in range(0, len(rows), block):
            some = rows[piece : piece + block]
            value = other[: len(some) * narrow].reshape(len(some), narrow)
            first(chain, some, chosen[:count], start[:count], shift, given, value)
            found = told(chain, value, one, other)
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
def squares(chain, out, lines, after, rows, wanted, known, whole, gates, masks):
    """Squared error of every element of every row under every mask.

    It is 0 where a row has not all signals of a mask, or an element does not count.

    Args:
        chain: The network.
        out: Where they go, of each mask to a line, from a row on; shape (lines, rows, size).
        lines: Shape (masks,).
        after: The row.
        rows: Shape (rows, size + bias_size).
        wanted: Shape (rows, size).
        known: Shape (rows, size).
        whole: Shape (rows, signals).
        gates: Shape (masks, size).
        masks: Shape (masks, signals).
    """
    count, width, narrow = len(rows), widest(chain), chain.form[0, NARROW]
    one, other = np.empty(count * width, rows.dtype), np.empty(count * width, rows.dtype)
    start, shift = np.empty((rows.shape[1], narrow), rows.dtype), np.empty(narrow, rows.dtype)
    chosen, given = np.empty(rows.shape[1], np.int64), np.empty(rows.size, rows.dtype)
    value = other[: count * narrow].reshape(count, narrow)
    for index in range(len(masks)):
        inputs = begin(chain, gates[index], masks[index], chosen, start, shift)
        first(chain, rows, chosen[:inputs], start[:inputs], shift, given, value)
        found = told(chain, value, one, other)
        for row in range(count):
            line, aim, counts = found[row], wanted[row], known[row]
            target = out[lines[index], after + row]
            if usable(whole, masks[index], row):
                for i in range(len(target)):
                    miss = line[i] - aim[i]
                    target[i] = counts[i] * miss * miss
            else:
                target[:] = 0.0


@jit
def estimates(squared, lines, judged, weights, known, project, doubt, hidden):
    """What the first rows tell of all; see `gemuco.row_draw.Heat` for weights and what follows.

    Args:
        squared: Of `squares`, shape (lines, rows, size).
        lines: Of the masks, shape (masks,).
        judged: How much an element's error adds to that of a mask, shape (masks, size).
        weights: Shape (rows,).
        known: Shape (rows, k).
        project: Shape (rows, k).
        doubt: Shape (rows,).
        hidden: Shape (rows,).

    Returns:
        Means of every element, shape (masks, size), and of the error of a mask the variance and what the worst unseen
        row may hide, shapes (masks,).
    """
    count, k = known.shape
    told, variance, worst = np.zeros((len(lines), squared.shape[2])), np.empty(len(lines)), np.empty(len(lines))
    value, part = np.empty(count), np.empty(k)
    for index in range(len(lines)):
        whole, factor, mean = squared[lines[index]], judged[index], told[index]
        part[:] = 0.0
        worst[index] = 0.0
        for row in range(count):
            line, weight, total = whole[row], weights[row], 0.0
            for i in range(len(mean)):
                mean[i] += weight * line[i]
                total += factor[i] * line[i]
            value[row] = total
            worst[index] = max(worst[index], hidden[row] * total)
            for i in range(k):
                part[i] += project[row, i] * total
        variance[index] = 0.0
        for row in range(count):
            left = value[row]
            for i in range(k):
                left -= known[row, i] * part[i]
            variance[index] += doubt[row] * left * left
    return told, variance, worst
