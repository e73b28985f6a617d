"""Squared errors of one network under many masks on the same rows; see `gemuco.structure.mask_errors`.

Elements that a mask removes are left out of the rows and of the first layer's matrix; the bits of the mask and the
linear path are folded into its offset and matrix. Rows are processed in blocks whose values stay in the second-level
cache.
"""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.bend import bend
from gemuco.compiled.blas import times
from gemuco.compiled.chain import BENT, CODE, NARROW, matrix, offset
from gemuco.compiled.jit import jit

BLOCK = 256
"""A block has this many rows: smaller blocks give less efficient products, larger ones do not fit into the cache."""


class Rows(NamedTuple):
    """Samples on which masks are measured.

    Attributes:
        inputs: Elements, gaps filled, and p, shape (rows, size + bias_size).
        targets: Elements, gaps filled, shape (rows, size).
        counts: 1 for elements whose error counts, else 0, shape (rows, size).
        whole: Whether all elements of a signal are there, shape (rows, signals); a mask needs all of its signals.
    """

    inputs: np.ndarray
    targets: np.ndarray
    counts: np.ndarray
    whole: np.ndarray


class Buffers(NamedTuple):
    """Memory of one core.

    Attributes:
        columns: Indices of the input columns under the mask, shape (size + bias_size,).
        start: The first layer's matrix for these columns, shape (size + bias_size, n_out).
        shift: The first layer's offset under the mask, shape (n_out,).
        inputs: Input values of a block, shape (BLOCK * (size + bias_size),).
        even: Values of every other layer, shape (BLOCK * widest,).
        odd: Values of the other layers, shape (BLOCK * widest,).
    """

    columns: np.ndarray
    start: np.ndarray
    shift: np.ndarray
    inputs: np.ndarray
    even: np.ndarray
    odd: np.ndarray


@jit
def make_buffers(chain, columns):
    """Allocate buffers for rows of `columns` inputs."""
    width, narrow = 0, chain.form[0, NARROW]
    for layer in range(len(chain.form)):
        width = max(width, chain.form[layer, NARROW])
    return Buffers(
        np.empty(columns, np.int64),
        np.empty((columns, narrow), np.float32),
        np.empty(narrow, np.float32),
        np.empty(BLOCK * columns, np.float32),
        np.empty(BLOCK * width, np.float32),
        np.empty(BLOCK * width, np.float32),
    )


@jit
def begin(chain, gate, path, bits, buffers):
    """Prepare the first layer under one mask: `columns`, `start` and `shift` of the buffers.

    Args:
        chain: The network: elements, bits and p in.
        gate: 1 for elements of the mask's signals, else 0, shape (size,).
        path: Regression of the code l under the mask, shape (size + 1, width).
        bits: The mask, shape (signals,).
        buffers: Changed in place.

    Returns:
        Number of columns under the mask; `columns` and `start` are undefined beyond it.
    """
    whole, plain, count = matrix(chain, 0), offset(chain, 0), 0
    size, width, signals, shift = len(gate), path.shape[1], len(bits), buffers.shift
    for k in range(len(shift)):
        shift[k] = plain[k]
        for j in range(width):
            shift[k] += path[size, j] * whole[size + j, k]
    for i in range(signals):
        if bits[i] > 0.0:
            for k in range(len(shift)):
                shift[k] += whole[size + width + i, k]
    for i in range(len(buffers.start)):
        if i >= size or gate[i] > 0.0:
            buffers.columns[count] = i
            line = i if i < size else i + width + signals
            for k in range(len(shift)):
                buffers.start[count, k] = whole[line, k]
                if i < size:
                    for j in range(width):
                        buffers.start[count, k] += path[i, j] * whole[size + j, k]
            count += 1
    return count


@jit
def predict(chain, rows, first, count, columns, buffers):
    """Return the outputs of up to `BLOCK` rows under the mask of `begin`, shape (count, size), in the buffers."""
    even, odd, shift = buffers.even, buffers.odd, buffers.shift
    inputs = buffers.inputs[: count * columns].reshape(count, columns)
    for row in range(count):
        for i in range(columns):
            inputs[row, i] = rows.inputs[first + row, buffers.columns[i]]
    value = odd[: count * len(shift)].reshape(count, len(shift))
    times(inputs, buffers.start[:columns], value)
    bend(value, shift, chain.form[0, CODE], chain.form[0, BENT])
    for layer in range(1, len(chain.form)):
        width = chain.form[layer, NARROW]
        result = even[: count * width].reshape(count, width)
        times(value, matrix(chain, layer), result)
        bend(result, offset(chain, layer), chain.form[layer, CODE], chain.form[layer, BENT])
        value = result
        even, odd = odd, even
    return value


@jit
def has_signals(rows, row, bits):
    """Return whether a row has all signals of a mask."""
    has_all = True
    for i in range(len(bits)):
        has_all &= rows.whole[row, i] or bits[i] == 0.0
    return has_all


@jit
def squared_errors(chain, rows, gates, paths, masks):
    """Return the sum of squared errors over the rows, shape (masks, size).

    A row without all signals of the mask adds nothing, nor does an element that does not count.

    Args:
        chain: The network.
        rows: The samples.
        gates: 1 for elements of a mask's signals, else 0, shape (masks, size).
        paths: Regression of the code l under every mask, shape (masks, size + 1, width).
        masks: 1 for signals of a mask, else 0, shape (masks, signals).
    """
    total, size = np.zeros(gates.shape), gates.shape[1]
    buffers = make_buffers(chain, rows.inputs.shape[1])
    for mask in range(len(masks)):
        columns = begin(chain, gates[mask], paths[mask], masks[mask], buffers)
        for first in range(0, len(rows.inputs), BLOCK):
            count = min(BLOCK, len(rows.inputs) - first)
            outputs = predict(chain, rows, first, count, columns, buffers)
            for row in range(count):
                if has_signals(rows, first + row, masks[mask]):
                    for i in range(size):
                        error = outputs[row, i] - rows.targets[first + row, i]
                        total[mask, i] += rows.counts[first + row, i] * error * error
    return total
