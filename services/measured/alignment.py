"""Rows at a fixed rate from rows that hold one message each: every value is interpolated between its own samples."""

from collections.abc import Mapping

import numpy as np

MOST = 50_000
"""Of a longer table about this many rows show which values come together."""
APART = 0.01
"""Two columns are apart if at most this share of the samples of the rarer one has a value of the other."""
LONG = 10.0
"""A pause of a column longer than this many of its usual steps is not bridged."""


def merged(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Join the rows of several files, each with its own stamps, in the order of the stamps.

    Args:
        parts: Stamps [s], shape (rows,), and values, shape (rows, n), of every file.

    Returns:
        Stamps [s], shape (all rows,), and the values of all files side by side, NaN where a row is of another file.
        The rows of a single file stay as they are, so that a clock that begins anew is seen.
    """
    if len(parts) == 1:
        return parts[0]
    stamps = np.concatenate([own for own, _ in parts])
    values = np.full((len(stamps), sum(part.shape[1] for _, part in parts)), np.nan)
    row = column = 0
    for _, part in parts:
        values[row : row + len(part), column : column + part.shape[1]] = part
        row, column = row + len(part), column + part.shape[1]
    order = np.argsort(stamps, kind="stable")
    return stamps[order], values[order]


def aligned(stamps: np.ndarray, values: np.ndarray, rate: float, pause: float) -> np.ndarray:
    """Interpolate every column linearly at a fixed rate.

    Args:
        stamps: Time of every row [s], shape (rows,), in any order.
        values: Shape (rows, n), NaN where a row has no value.
        rate: Rows per second of the result [Hz].
        pause: Between two samples of a column that are further apart than this [s], or than `LONG`, nothing is known.

    Returns:
        Values from the first stamp on, shape (ticks, n), NaN where nothing is known.
    """
    order = np.argsort(stamps, kind="stable")
    stamps, values = stamps[order], values[order]
    ticks = stamps[0] + np.arange(int((stamps[-1] - stamps[0]) * rate + 1e-6) + 1) / rate
    result = np.full((len(ticks), values.shape[1]), np.nan)
    for column, (own, usual) in enumerate(zip(values.T, usual_steps(stamps, values), strict=True)):
        known = np.flatnonzero(np.isfinite(own))
        if not len(known):
            continue
        at = stamps[known]
        after = np.searchsorted(at, ticks - 1e-9)
        before = np.searchsorted(at, ticks + 1e-9, side="right") - 1
        inside = (before >= 0) & (after < len(at))
        step = at[np.minimum(after, len(at) - 1)] - at[np.maximum(before, 0)]
        inside &= step <= np.fmin(pause, LONG * usual) + 1e-9
        result[inside, column] = np.interp(ticks[inside], at, own[known])
    return result


def usual_steps(stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the usual time between the samples of each column [s], shape (n,), NaN with less than two samples."""
    usual = np.full(values.shape[1], np.nan)
    for column, own in enumerate(values.T):
        between = np.diff(np.sort(stamps[np.isfinite(own) & np.isfinite(stamps)]))
        if (between > 0.0).any():
            usual[column] = np.median(between[between > 0.0])
    return usual


def are_apart(values: np.ndarray) -> bool:
    """Whether some columns, shape (rows, n), hardly ever have values in the same row, so that no row relates them."""
    known = np.isfinite(values[:: max(1, len(values) // MOST)]).astype(np.float32)
    known = known[:, known.any(axis=0)]
    count = known.sum(axis=0)
    return bool((known.T @ known < APART * np.minimum(count, count[:, None])).any())


def by_signal(values: np.ndarray, sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Return the columns of every signal, shape (rows, size), of columns side by side."""
    parts = np.split(values, np.cumsum(list(sizes.values()))[:-1], axis=1)
    return dict(zip(sizes, parts, strict=True))
