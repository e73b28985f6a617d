"""Samples outside of what was learned: larger errors are to be expected there, and are no anomaly by themselves.

The score knows only errors within the learned data. How much larger they become with the distance from these data
follows from the closed-form predictions of single elements (`gemuco.intervals.regression`).
"""

import numpy as np

from gemuco.anomaly.prediction import with_bias
from gemuco.intervals.region import learned_range
from gemuco.intervals.regression import Fit
from gemuco.normal.watch import PATTERNS
from gemuco.schema import BodySchema

EXPECTED, FOLLOWED = 6.0, 24.0
"""The mean error of an element in a window is to be expected below the first number of standard deviations that a
healthy body has at this distance from the learned data; below the second one for an element that is outside of its
learned range and predicted there by the others, because its own relations to them are the least known."""


def outside(schema: BodySchema, rows: np.ndarray) -> str:
    """Return the element that is furthest outside of its learned range, if this explains the errors of a window.

    It does if the others predict it outside too, and fit each other as well as can be expected at this distance from
    the learned data. A sensor that only shows such a value is contradicted by the others.

    Args:
        schema: A schema with statistics of prediction errors.
        rows: Samples [standard deviations], shape (n, size).

    Returns:
        `signal.element`, or empty.
    """
    whole, (low, high) = with_bias(schema, rows), learned_range(schema)
    furthest, most = "", 0.0
    for fit in _fits(schema, np.isfinite(rows).all(axis=0)):
        place, features = fit.elements[0], fit.reading.features(whole)
        values = np.array([rows[:, place], features @ fit.maps[:, 0]]).mean(axis=1)
        over = float(max((low[place] - values).min(), (values - high[place]).min()) / (high[place] - low[place]))
        error = abs(values[0] - values[1]) / (fit.std[0] * fit.growth(features).mean())
        if error >= (FOLLOWED if over > 0.0 else EXPECTED):
            return ""
        if over > most:
            furthest, most = schema.layout.element(int(place)), over
    return furthest


def _fits(schema: BodySchema, finite: np.ndarray) -> list[Fit]:
    """Return the prediction of every measured element from all other measured ones, which W and p do not change.

    Args:
        schema: The body schema.
        finite: Whether each element is measured, shape (size,).
    """
    normal, key = schema.normal, ("alone", finite.tobytes())
    if normal is None:
        return []
    if key not in normal.known:
        places = np.arange(len(finite))
        fits = (Fit.of(schema, finite & (places != place)) for place in np.flatnonzero(finite))
        if len(normal.known) >= PATTERNS:
            normal.known.clear()
        normal.known[key] = [fit for fit in fits if fit is not None]
    return list(normal.known[key])
