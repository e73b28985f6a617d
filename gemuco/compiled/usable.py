"""What of a sample may be used, element by element."""

import numpy as np

from gemuco.compiled.jit import jit


@jit
def usable(values, valid, age, of, to, stale_after, found):
    """Take what is valid and not too old.

    Args:
        values: Of the sample [unit of each element], shape (n,).
        valid: Whether they may be used, shape (n,).
        age: How old they were when the sample was published [s], shape (n,).
        of: Which of them are taken, shape (k,).
        to: Where each of these goes, shape (k,).
        stale_after: How old each may be there [s], shape (size,).
        found: Is filled in, NaN for all that may not be used, shape (size,).

    Returns:
        Whether anything may be used.
    """
    is_any = False
    for i in range(len(found)):
        found[i] = np.nan
    for k in range(len(of)):
        i, j = of[k], to[k]
        if valid[i] and age[i] <= stale_after[j]:
            found[j] = values[i]
            is_any = is_any or np.isfinite(values[i])
    return is_any
