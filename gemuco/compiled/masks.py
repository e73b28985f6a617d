"""One network under many masks: its squared errors on the same rows; see `gemuco.structure.mask_errors`.

What a mask keeps back is left out of the rows and of the first layer's matrix, and its bits are added to the offset.
Rows go in blocks whose values stay in the second-level cache.
"""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.bend import bend
from gemuco.compiled.blas import times
from gemuco.compiled.chain import CODE, NARROW, matrix, offset
from gemuco.compiled.jit import jit

BLOCK = 256
"""Rows at a time, at most: of smaller blocks a product has less, larger ones leave the cache."""


class Rows(NamedTuple):
    """What masks are tried on.

    Attributes:
        given: Elements, gaps filled, and p, shape (rows, size + bias_size).
        wanted: Shape (rows, size), gaps filled.
        known: 1 for elements that count, else 0, shape (rows, size).
        whole: Which signals are whole, shape (rows, signals): a mask is tried where all of its are.
    """

    given: np.ndarray
    wanted: np.ndarray
    known: np.ndarray
    whole: np.ndarray


class Room(NamedTuple):
    """Where one core works on up to `BLOCK` rows.

    Attributes:
        chosen: Which columns of the rows go in, the elements that a mask lets through and p; (size + bias_size,).
        start: The first layer's matrix for these, shape (size + bias_size, n_out).
        shift: The first layer's offset under the mask, shape (n_out,).
        given: What goes in, shape (BLOCK * (size + bias_size),).
        one: Values of every other layer, shape (BLOCK * widest,).
        other: Values of the layers between.
    """

    chosen: np.ndarray
    start: np.ndarray
    shift: np.ndarray
    given: np.ndarray
    one: np.ndarray
    other: np.ndarray


@jit
def make_room(chain, columns):
    """For rows of so many columns."""
    width, narrow = 0, chain.form[0, NARROW]
    for layer in range(len(chain.form)):
        width = max(width, chain.form[layer, NARROW])
    return Room(
        np.empty(columns, np.int64),
        np.empty((columns, narrow), np.float32),
        np.empty(narrow, np.float32),
        np.empty(BLOCK * columns, np.float32),
        np.empty(BLOCK * width, np.float32),
        np.empty(BLOCK * width, np.float32),
    )


@jit
def begin(chain, gate, bits, room):
    """The first layer under one mask: the first three of `Room`.

    Args:
        chain: The network: elements, bits and p in.
        gate: 1 for elements that the mask lets through, else 0, shape (size,).
        bits: The mask, shape (signals,).
        room: Is changed.

    Returns:
        How many columns go in: what lies behind them in `chosen` and `start` is of no use.
    """
    whole, plain, count = matrix(chain, 0), offset(chain, 0), 0
    size, signals, shift = len(gate), len(bits), room.shift
    for k in range(len(shift)):
        shift[k] = plain[k]
    for i in range(signals):
        if bits[i] > 0.0:
            for k in range(len(shift)):
                shift[k] += whole[size + i, k]
    for i in range(len(room.start)):
        if i >= size or gate[i] > 0.0:
            room.chosen[count] = i
            line = i if i < size else i + signals
            for k in range(len(shift)):
                room.start[count, k] = whole[line, k]
            count += 1
    return count


@jit
def infer(chain, rows, first, count, inputs, room):
    """What the network makes of up to `BLOCK` rows under the mask of `begin`, shape (count, size), in the room."""
    one, other, shift = room.one, room.other, room.shift
    given = room.given[: count * inputs].reshape(count, inputs)
    for row in range(count):
        for i in range(inputs):
            given[row, i] = rows.given[first + row, room.chosen[i]]
    value = other[: count * len(shift)].reshape(count, len(shift))
    times(given, room.start[:inputs], value)
    bend(value, shift, chain.form[0, CODE])
    for layer in range(1, len(chain.form)):
        width = chain.form[layer, NARROW]
        result = one[: count * width].reshape(count, width)
        times(value, matrix(chain, layer), result)
        bend(result, offset(chain, layer), chain.form[layer, CODE])
        value = result
        one, other = other, one
    return value


@jit
def usable(rows, row, bits):
    """Whether a row has all signals of a mask."""
    has_all = True
    for i in range(len(bits)):
        has_all &= rows.whole[row, i] or bits[i] == 0.0
    return has_all


@jit
def measure(chain, rows, first, count, bits, inputs, room, out, place):
    """Squared errors of up to `BLOCK` rows under the mask of `begin`, 0 where a row or an element does not count.

    Args:
        chain: The network.
        rows: All rows.
        first: The first of those that are measured.
        count: How many.
        bits: The mask, shape (signals,).
        inputs: What `begin` returned.
        room: Of `begin`.
        out: Shape (any, size).
        place: Its line that the first is for.
    """
    found = infer(chain, rows, first, count, inputs, room)
    for row in range(count):
        counts = usable(rows, first + row, bits)
        for i in range(out.shape[1]):
            miss = found[row, i] - rows.wanted[first + row, i]
            out[place + row, i] = rows.known[first + row, i] * miss * miss if counts else 0.0


@jit
def squares(chain, rows, gate, bits):
    """Squared error of every element of every row under a mask, shape (rows, size).

    It is 0 where a row has not all signals of the mask, or an element does not count.

    Args:
        chain: The network.
        rows: What it is tried on.
        gate: 1 for elements that the mask lets through, else 0, shape (size,).
        bits: 1 for the signals of the mask, else 0, shape (signals,).
    """
    count, size = rows.wanted.shape
    room, squared = make_room(chain, rows.given.shape[1]), np.empty((count, size), np.float32)
    inputs = begin(chain, gate, bits, room)
    for piece in range(0, count, BLOCK):
        measure(chain, rows, piece, min(BLOCK, count - piece), bits, inputs, room, squared, piece)
    return squared
