"""Check that statistics of normal errors can find an anomaly at all: with a blind detector every body looks healthy."""

from collections.abc import Iterator
from itertools import chain

import numpy as np

from gemuco.normal.statistics import FLOOR, Normal
from gemuco.normal.watch import Watch
from gemuco.normal.windows import SYSTEMATIC, Windows

LARGEST_ERROR = 100.0
"""The standard deviation of a normal error is at most this number of standard deviations of its signal; a prediction
that is always the mean has 1."""
LARGEST_LIMIT = 50.0
"""A limit of deviations is at most this number of standard deviations; those of learned models are below 6."""
LARGEST_SCATTER = 100.0
"""Within a window an element varies by at most this multiple of its variance in the training data."""
ROUNDING = 1e-4
"""Numbers that follow from each other may differ by this share."""


def check_normal(normal: Normal, spread: np.ndarray, inputs: int) -> None:
    """Check that the statistics mean what `Normal.fit` computes.

    Args:
        normal: Statistics with arrays of the right shapes.
        spread: Standard deviation of every element of x_out [unit], shape (out_size,).
        inputs: Number of elements of a sample and its p.

    Raises:
        ValueError: A number is impossible; the message names it.
    """
    for fault in chain(
        _rates(normal),
        _errors(normal, spread),
        () if normal.windows is None else _windows(normal.windows),
        _threshold(normal),
        () if normal.watch is None else _watch(normal.watch, inputs),
    ):
        raise ValueError(fault)


def _rates(normal: Normal) -> Iterator[str]:
    for name, value, low, high in (
        ("false_alarm", normal.false_alarm, 1e-9, 0.5),
        ("bound", normal.bound, 0.0, 1.0),
        ("shrink", normal.shrink, 0.0, 1.0),
        ("samples", normal.samples, 0.0, 1e15),
        ("mean of its scale", 0.0 if normal.scale is None else normal.scale.mean, -LARGEST_LIMIT, LARGEST_LIMIT),
        ("std of its scale", 1.0 if normal.scale is None else normal.scale.std, 1e-4, LARGEST_LIMIT),
        ("near_std of its scale", 1.0 if normal.scale is None else normal.scale.near_std, 1e-12, LARGEST_LIMIT),
        ("weight of its scale", 0.0 if normal.scale is None else normal.scale.weight, 0.0, 1e6),
    ):
        if not low <= value <= high:
            yield f"normal errors have the {name} {value}, which is not within {low:g} and {high:g}"


def _errors(normal: Normal, spread: np.ndarray) -> Iterator[str]:
    if not normal.usual:
        yield "no error has a mean, so no sample would ever be judged"
    if np.isinf(normal.mean).any():
        yield "a mean normal error is infinite"
    matrix = normal.covariance
    whole = np.concatenate([spread, np.ones(len(matrix) - len(spread))])
    deviations = np.sqrt(np.maximum(np.diag(matrix), 0.0)) / whole
    if (np.diag(matrix) <= 0.0).any() or not np.allclose(matrix, matrix.T, rtol=ROUNDING, atol=0.0):
        yield "the covariance of normal errors has a variance that is not positive, or is not symmetric"
    elif deviations.min() < 0.9 * FLOOR or deviations.max() > LARGEST_ERROR:
        yield (
            f"normal errors of {deviations.min():.3g} to {deviations.max():.3g} standard deviations of their signals "
            f"are not within {FLOOR:g} and {LARGEST_ERROR:g}"
        )
    elif np.linalg.eigvalsh(matrix / np.outer(whole, whole))[0] <= 0.0:
        yield "the covariance of normal errors is not positive definite"


def _threshold(normal: Normal) -> Iterator[str]:
    if normal.scale is None or normal.windows is None:
        if not 0.0 < normal.threshold <= LARGEST_ERROR * np.sqrt(normal.usual):
            yield f"the threshold {normal.threshold} finds no anomaly"
        return
    expected = float(normal.scale.distance(normal.windows.limits[0]))
    if not abs(normal.threshold - expected) <= ROUNDING * expected:
        yield f"the threshold {normal.threshold} does not follow from its limit, which makes {expected:.6g}"


def _windows(windows: Windows) -> Iterator[str]:
    sizes = windows.sizes
    if not len(sizes) or sizes[0] != 1 or (np.diff(sizes) <= 0).any():
        yield "the sizes of windows do not ascend from 1"
    for name in ("limits", "shift"):
        values = getattr(windows, name)
        if not (np.abs(values) <= LARGEST_LIMIT).all():
            yield f"the {name} of windows {values.max():.3g} finds no anomaly"
    for name in ("stds", "shift_stds"):
        values = getattr(windows, name)
        if not ((values > 0.0) & (values <= LARGEST_LIMIT)).all():
            yield f"the {name} of windows are not within 0 and {LARGEST_LIMIT:g}"
    if not ((windows.variance >= 0.9 * SYSTEMATIC) & (windows.variance <= LARGEST_ERROR)).all():
        yield f"the variances of windows are not within {SYSTEMATIC:g} and {LARGEST_ERROR:g}"
    if windows.scatter is not None:
        known = windows.scatter[np.isfinite(windows.scatter)]
        if not ((known >= 0.0) & (known <= LARGEST_SCATTER)).all():
            yield f"the scatter within windows is not within 0 and {LARGEST_SCATTER:g}"


def _watch(watch: Watch, inputs: int) -> Iterator[str]:
    if len(watch.inputs) and not (watch.inputs.min() >= 0 and watch.inputs.max() < inputs):
        yield f"the watch has an input beyond {inputs} elements"
    if (watch.low >= watch.high).any():
        yield "the watch clips its inputs to nothing"
    if not ((watch.penalties > 0.0) & (watch.penalties <= 1e6)).all() or not watch.count > 0:
        yield "the watch has a penalty or a number of samples that is not positive"
    if (np.diag(watch.moments) < 0.0).any() or not np.allclose(
        watch.moments, watch.moments.T, rtol=ROUNDING, atol=1e-9
    ):
        yield "the moments of the watch are not those of any samples"
