"""Training batch of samples, each once under every mask that it allows."""

import numpy as np

from gemuco.compiled.jit import jit


@jit
def under_masks(rows, biases, through, paths, bits, directs, predictor):
    """Return the inputs and target outputs of every mask and every sample that has all elements of the mask.

    The targets are those of the network: x_out without the part of the linear path, NaN where the network has no part.

    Args:
        rows: Samples [standard deviations], shape (n, size), float32; NaN where not measured.
        biases: p of every sample, shape (n, bias_size).
        through: 1 for elements of x_in that a mask lets through, else 0, shape (masks, in_size).
        paths: Regression of the code l under every mask, shape (masks, in_size + 1, width).
        bits: m of every mask, shape (masks, x_in).
        directs: Part of the linear path in x_out under every mask, shape (masks, in_size + 2, out_size).
        predictor: Positions of x_in and x_out in the layout, and the limit of inputs.

    Returns:
        Inputs of the network, shape (k, n_in); its targets, shape (k, out_size); the weights of their squared errors,
        shape (k, out_size), with which these are squared errors of x_out; and the index of the sample, shape (k,). They
        are ordered by mask.
    """
    masks, count = through.shape
    signals, wide = bits.shape[1], paths.shape[2]
    head = count + wide
    width = head + signals + biases.shape[1]
    allowed = np.ones((masks, len(rows)), np.bool_)
    for mask in range(masks):
        for row in range(len(rows)):
            for i in range(count):
                if through[mask, i] > 0.0 and not np.isfinite(rows[row, predictor.inputs[i]]):
                    allowed[mask, row] = False
                    break
    size = int(allowed.sum())
    inputs = np.zeros((size, width), np.float32)
    targets = np.empty((size, len(predictor.outputs)), np.float32)
    weights = np.empty((size, len(predictor.outputs)), np.float32)
    samples = np.empty(size, np.int64)
    clip, k = np.float32(predictor.clip), 0
    for mask in range(masks):
        for row in range(len(rows)):
            if allowed[mask, row]:
                for j in range(wide):
                    inputs[k, count + j] = paths[mask, count, j]
                for i in range(count):
                    if through[mask, i] > 0.0:
                        x = rows[row, predictor.inputs[i]]
                        inputs[k, i] = min(max(x, -clip), clip)
                        for j in range(wide):
                            inputs[k, count + j] += x * paths[mask, i, j]
                for i in range(signals):
                    inputs[k, head + i] = bits[mask, i]
                for i in range(biases.shape[1]):
                    inputs[k, head + signals + i] = biases[row, i]
                for i in range(len(predictor.outputs)):
                    targets[k, i] = rows[row, predictor.outputs[i]]
                    share = directs[mask, count + 1, i]
                    weights[k, i] = share * share
                    if share == 0.0:
                        targets[k, i] = np.nan
                    elif share < 1.0:
                        line = directs[mask, count, i]
                        for j in range(count):
                            if through[mask, j] > 0.0:
                                line += rows[row, predictor.inputs[j]] * directs[mask, j, i]
                        targets[k, i] = (targets[k, i] - line) / share
                samples[k] = row
                k += 1
    return inputs, targets, weights, samples
