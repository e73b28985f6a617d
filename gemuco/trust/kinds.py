"""Kinds of lies: the simplest description of a wrong element's values that fits what the others predict."""

import numpy as np

TURN = 2.0 * np.pi
STILL = 0.1
"""A frozen value moves by less than this [errors of a healthy prediction]."""
MOVED = 1.5
"""Meanwhile its prediction moves by at least this."""
CONSTANT = 0.35
"""The error of an offset varies by less than this share of it."""
BETTER = 0.5
"""A kind with one more number must leave less than this share of the squared error."""


def kind_of(
    value: np.ndarray, error: np.ndarray, healthy: float, std: float, unit: str, is_noise: bool,
    others: np.ndarray | None = None, span: float = np.inf, has_jumped: bool = False,
) -> str:  # fmt: skip
    """Return the kind of a lie; `unknown` of fewer than three blocks that no simple kind fits.

    Args:
        value: Measured since it began [standard deviations of the signal], shape (blocks,).
        error: Measured minus predicted from trusted elements only, shape (blocks,).
        healthy: Error of a healthy prediction [standard deviations].
        std: Standard deviation of the signal [unit].
        unit: Unit of the element.
        is_noise: Whether its noise is the strongest evidence.
        others: Predictions of other elements of the signal that are wrong too [unit of `value`], shape (blocks, n).
        span: Largest range of the value within a block [standard deviations].
        has_jumped: Whether it began with a jump; then a constant value of a body at rest is not frozen.
    """
    if is_noise:
        return "noise"
    predicted = value - error
    if others is not None and others.size and len(value) >= 3:
        miss = np.abs(value[:, None] - others).mean(axis=0).min()
        if miss < BETTER * np.abs(error).mean():
            return "swapped"
    if len(value) >= 2 and max(np.ptp(value), min(span, np.inf)) < STILL * healthy:
        if np.ptp(predicted) > MOVED * healthy:
            outer = np.abs(predicted).min() >= abs(value.mean()) and np.all(predicted * value.mean() > 0)
            return "clipped" if outer else "frozen"
        if len(value) >= 3 and not has_jumped:
            return "frozen"
    mean = float(np.median(error))
    turns = mean * std / TURN
    if unit == "rad" and abs(round(turns)) >= 1 and abs(turns - round(turns)) * TURN < max(3.0 * healthy * std, 0.05):
        return "wrap"
    if len(value) < 5 or np.std(error) < CONSTANT * abs(mean):
        return "offset"
    return _fitted(predicted, error, healthy)


def _fitted(predicted: np.ndarray, error: np.ndarray, healthy: float) -> str:
    """Return the kind whose line fits the error: constant, growing with time, or with the value."""
    left = float(np.sum((error - error.mean()) ** 2))
    time = np.arange(len(error)) - (len(error) - 1) / 2.0
    constant = max(left, len(error) * (0.5 * healthy) ** 2)
    by_time = left - float(time @ error) ** 2 / float(time @ time)
    kinds = {"drift": by_time}
    spread = predicted - predicted.mean()
    if np.std(predicted) > 2.0 * healthy:
        slope = float(spread @ error) / float(spread @ spread)
        by_value = left - slope**2 * float(spread @ spread)
        kinds["sign" if -2.5 < slope < -1.5 else "gain"] = by_value
    best = min(kinds, key=lambda kind: kinds[kind])
    return best if kinds[best] < BETTER * constant else "offset"
