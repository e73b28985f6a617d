"""Mask of the stale and invalid elements of a sample."""

import numpy as np

from gemuco.compiled.jit import jit


@jit
def usable(values, valid, age, of, to, stale_after, result):
    """Copy the elements of a sample that are valid and not stale.

    Args:
        values: Values of the sample [unit of each element], shape (n,).
        valid: Whether each value is valid, shape (n,).
        age: Age of each value when the sample was published [s], shape (n,).
        of: Indices of the values to copy, shape (k,).
        to: Index of each of these in the result, shape (k,).
        stale_after: Largest age of each element of the result [s], shape (size,).
        result: Result, NaN for stale and invalid elements, shape (size,).

    Returns:
        Whether any element is usable.
    """
    is_any = False
    for i in range(len(result)):
        result[i] = np.nan
    for k in range(len(of)):
        i, j = of[k], to[k]
        if valid[i] and age[i] <= stale_after[j]:
            result[j] = values[i]
            is_any = is_any or np.isfinite(values[i])
    return is_any
