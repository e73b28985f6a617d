"""Chain of layers for compiled code, and its passes; `gemuco.layers` has the same in numpy with more explanation.

The values of all layers are in one array, one layer after another, so that a pass allocates no memory per layer. Loops
are written out and all products call two functions, because compiling an array expression takes seconds.
"""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.bend import CODES, bend, bends, slopes
from gemuco.compiled.blas import times, times_turned
from gemuco.compiled.jit import jit
from gemuco.layers import Chain


class Packed(NamedTuple):
    """A chain of layers.

    Attributes:
        flat: Matrix (n_in, n_out) and offset (n_out,) of every layer, one after another, float32.
        form: For every layer n_in, n_out, the position of its matrix in `flat`, the sum of all widths before its
            output, its activation (`bend.CODES`), and how many columns have it, shape (layers, 6).
    """

    flat: np.ndarray
    form: np.ndarray


WIDE, NARROW, PLACE, BEFORE, CODE, BENT = range(6)


def pack(chain: Chain) -> Packed:
    """Convert a chain for compiled code."""
    form, place, before = np.zeros((len(chain), 6), np.int64), 0, 0
    for index, layer in enumerate(chain):
        wide, narrow = layer.matrix.shape
        before += wide
        form[index] = wide, narrow, place, before, CODES[layer.activation], layer.bent
        place += (wide + 1) * narrow
    flat = np.empty(place, np.float32)
    for layer, (wide, narrow, begin, *_) in zip(chain, form, strict=True):
        flat[begin : begin + wide * narrow].reshape(wide, narrow)[:] = layer.matrix
        flat[begin + wide * narrow : begin + (wide + 1) * narrow] = layer.offset
    return Packed(flat, form)


def turned(chain: Packed) -> np.ndarray:
    """Return `Packed.flat` with every matrix transposed, which halves the time of products of few rows."""
    flat = chain.flat.copy()
    for wide, narrow, place, *_ in chain.form:
        part = chain.flat[place : place + wide * narrow].reshape(wide, narrow)
        flat[place : place + wide * narrow].reshape(narrow, wide)[:] = part.T
    return flat


def unpack(chain: Packed) -> list[np.ndarray]:
    """Copy every matrix and offset, in the order of the layers."""
    flat, arrays = chain.flat.copy(), []
    for wide, narrow, place, *_ in chain.form:
        middle = place + wide * narrow
        arrays += [flat[place:middle].reshape(wide, narrow), flat[middle : middle + narrow]]
    return arrays


@jit
def matrix(chain, layer):
    """Return matrix W of a layer, shape (n_in, n_out)."""
    place, wide, narrow = chain.form[layer, PLACE], chain.form[layer, WIDE], chain.form[layer, NARROW]
    return chain.flat[place : place + wide * narrow].reshape(wide, narrow)


@jit
def offset(chain, layer):
    """Return offset b of a layer, shape (n_out,)."""
    place = chain.form[layer, PLACE] + chain.form[layer, WIDE] * chain.form[layer, NARROW]
    return chain.flat[place : place + chain.form[layer, NARROW]]


@jit
def space(chain, rows):
    """Allocate memory for the values of all layers."""
    last = len(chain.form) - 1
    return np.empty(rows * (chain.form[last, BEFORE] + chain.form[last, NARROW]), chain.flat.dtype)


@jit
def first(chain, values, rows):
    """Return the input, shape (rows, n_in)."""
    return values[: rows * chain.form[0, WIDE]].reshape(rows, chain.form[0, WIDE])


@jit
def after(chain, values, rows, layer):
    """Return the value after a layer, shape (rows, n_out)."""
    begin, width = rows * chain.form[layer, BEFORE], chain.form[layer, NARROW]
    return values[begin : begin + rows * width].reshape(rows, width)


@jit
def forward(chain, values, rows):
    """Compute the value after every layer from the input in `values`; return the last, shape (rows, n_out)."""
    value = first(chain, values, rows)
    for layer in range(len(chain.form)):
        result = after(chain, values, rows, layer)
        times(value, matrix(chain, layer), result)
        bend(result, offset(chain, layer), chain.form[layer, CODE], chain.form[layer, BENT])
        value = result
    return value


@jit
def alone(chain, values, rows, row):
    """Copy the values of all layers for one row, in the layout of a pass with this row alone."""
    copy = space(chain, 1)
    of, to = first(chain, values, rows), first(chain, copy, 1)
    for i in range(to.shape[1]):
        to[0, i] = of[row, i]
    for layer in range(len(chain.form)):
        of, to = after(chain, values, rows, layer), after(chain, copy, 1, layer)
        for i in range(to.shape[1]):
            to[0, i] = of[row, i]
    return copy


@jit
def output(chain, line):
    """Return the output, shape (n_out,), for a single input, shape (n_in,)."""
    values = space(chain, 1)
    inputs = first(chain, values, 1)[0]
    for i in range(len(inputs)):
        inputs[i] = line[i]
    return forward(chain, values, 1)[0].copy()


@jit
def pull(chain, values, rows, begin, gradient):
    """Return the gradient with respect to the input from that with respect to the output, shapes (some, n).

    Args:
        chain: The layers.
        values: Values after `forward`.
        rows: Number of rows of the values.
        begin: Row of the first gradient; the others follow.
        gradient: Gradient with respect to the output; it is changed.
    """
    some = len(gradient)
    for layer in range(len(chain.form) - 1, -1, -1):
        code = chain.form[layer, CODE]
        if code:
            slopes(after(chain, values, rows, layer)[begin : begin + some], gradient, code, chain.form[layer, BENT])
        below = np.empty((some, chain.form[layer, WIDE]), gradient.dtype)
        times_turned(gradient, matrix(chain, layer), below)
        gradient = below
    return gradient


@jit
def pull_all(chain, back, values, gradient):
    """Do `pull` for all rows with the transposed matrices of `turned`."""
    rows = len(gradient)
    for layer in range(len(chain.form) - 1, -1, -1):
        place, wide, narrow = chain.form[layer, PLACE], chain.form[layer, WIDE], chain.form[layer, NARROW]
        if chain.form[layer, CODE]:
            slopes(after(chain, values, rows, layer), gradient, chain.form[layer, CODE], chain.form[layer, BENT])
        below = np.empty((rows, wide), gradient.dtype)
        times(gradient, back[place : place + wide * narrow].reshape(narrow, wide), below)
        gradient = below
    return gradient


@jit
def push_all(chain, values, rows, row):
    """Return the derivatives of one row's output by every element of its input, shape (n_in, n_out)."""
    begin = matrix(chain, 0).copy()
    if chain.form[0, CODE]:
        slopes(after(chain, values, rows, 0)[row : row + 1], begin, chain.form[0, CODE], chain.form[0, BENT])
    for layer in range(1, len(chain.form)):
        above = np.empty((len(begin), chain.form[layer, NARROW]), begin.dtype)
        times(begin, matrix(chain, layer), above)
        code, bent = chain.form[layer, CODE], chain.form[layer, BENT]
        if code:
            slopes(after(chain, values, rows, layer)[row : row + 1], above, code, bent)
        begin = above
    return begin


@jit
def mixed(chain, values, weights, tangents):
    """Return the derivatives of g = (dy/dx)^T w of a single row by x, along directions u_k.

    Args:
        chain: The layers.
        values: Values of one row, after `forward`.
        weights: w, shape (1, n_out).
        tangents: u, shape (k, n_in).

    Returns:
        dy/dx u, shape (k, n_out), and d(u . g)/dx, shape (k, n_in).
    """
    layers, count = len(chain.form), len(tangents)
    curves = space(chain, 1)  # a''(x) times the gradient that arrives there
    gradient = weights
    for layer in range(layers - 1, -1, -1):
        value, code, bent = after(chain, values, 1, layer), chain.form[layer, CODE], chain.form[layer, BENT]
        bends(value, gradient, after(chain, curves, 1, layer), code, bent)
        below = np.empty((1, chain.form[layer, WIDE]), weights.dtype)
        inner = gradient.copy()
        slopes(value, inner, code, bent)
        times_turned(inner, matrix(chain, layer), below)
        gradient = below
    pushed = space(chain, count)
    for layer in range(layers):
        above = after(chain, pushed, count, layer)
        times(tangents, matrix(chain, layer), above)
        tangents = above.copy()
        slopes(after(chain, values, 1, layer), tangents, chain.form[layer, CODE], chain.form[layer, BENT])
    second = np.zeros((count, chain.form[layers - 1, NARROW]), weights.dtype)
    for layer in range(layers - 1, -1, -1):
        slopes(after(chain, values, 1, layer), second, chain.form[layer, CODE], chain.form[layer, BENT])
        moved, curve = after(chain, pushed, count, layer), after(chain, curves, 1, layer)
        for row in range(count):
            for i in range(second.shape[1]):
                second[row, i] += moved[row, i] * curve[0, i]
        below = np.empty((count, chain.form[layer, WIDE]), weights.dtype)
        times_turned(second, matrix(chain, layer), below)
        second = below
    return tangents, second
