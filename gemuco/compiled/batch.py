"""What a network learns from samples: each once under every mask that it allows."""

import numpy as np

from gemuco.compiled.jit import jit


@jit
def under_masks(rows, biases, through, bits, predictor):
    """Inputs and wanted outputs.

    Args:
        rows: Samples [standard deviations], shape (n, size), float32; NaN where nothing was measured.
        biases: p of each, shape (n, bias_size).
        through: 1 for elements of x_in that a mask lets through, else 0, shape (masks, in_size).
        bits: m of every mask, shape (masks, x_in).
        predictor: Where x_in and x_out lie, and how far inputs may be.

    Returns:
        Mask after mask, the samples of which it lacks nothing: the network's inputs, shape (k, n_in); x_out, shape
        (k, out_size); and which sample each is of, shape (k,).
    """
    masks, count = through.shape
    told, width = bits.shape[1], count + bits.shape[1] + biases.shape[1]
    allowed = np.ones((masks, len(rows)), np.bool_)
    for mask in range(masks):
        for row in range(len(rows)):
            for i in range(count):
                if through[mask, i] > 0.0 and not np.isfinite(rows[row, predictor.inputs[i]]):
                    allowed[mask, row] = False
                    break
    size = int(allowed.sum())
    inputs = np.zeros((size, width), np.float32)
    wanted = np.empty((size, len(predictor.outputs)), np.float32)
    whose = np.empty(size, np.int64)
    clip, k = np.float32(predictor.clip), 0
    for mask in range(masks):
        for row in range(len(rows)):
            if allowed[mask, row]:
                for i in range(count):
                    if through[mask, i] > 0.0:
                        inputs[k, i] = min(max(rows[row, predictor.inputs[i]], -clip), clip)
                for i in range(told):
                    inputs[k, count + i] = bits[mask, i]
                for i in range(biases.shape[1]):
                    inputs[k, count + told + i] = biases[row, i]
                for i in range(len(predictor.outputs)):
                    wanted[k, i] = rows[row, predictor.outputs[i]]
                whose[k] = row
                k += 1
    return inputs, wanted, whose
