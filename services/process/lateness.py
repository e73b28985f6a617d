"""Statistics of the lateness of a loop's ticks, in bounded memory."""

import math
from collections import deque

import numpy as np

RESOLUTION = 1e-6
"""A lateness below this [s] counts as punctual."""
GROWTH = 1.05
"""Neighbouring bins have this ratio, so quantiles since start are exact to 5 %."""
BINS = 400
"""This number of bins covers RESOLUTION * GROWTH**400: five minutes."""


class Lateness:
    """The exact quantiles of the newest ticks, and those of all ticks to 5 %.

    Args:
        recent: Number of ticks that count as recent.
    """

    def __init__(self, recent: int) -> None:
        self._recent: deque[float] = deque(maxlen=max(1, recent))
        self._counts = [0] * BINS
        self._worst = 0.0

    def add(self, late: float) -> None:
        """Add the lateness [s] of one tick."""
        self._recent.append(late)
        self._worst = max(self._worst, late)
        self._counts[_bin(late)] += 1

    def recent(self) -> dict[str, float]:
        """Return `late_p50`, `late_p99`, `late_max` [s] of the recent ticks; 0 before the first."""
        values = list(self._recent)  # one bytecode: safe beside a thread that appends
        if not values:
            return {"late_p50": 0.0, "late_p99": 0.0, "late_max": 0.0}
        p50, p99 = np.quantile(values, (0.5, 0.99))
        return {"late_p50": float(p50), "late_p99": float(p99), "late_max": max(values)}

    def total(self) -> dict[str, float]:
        """Return `total_p50`, `total_p99`, `total_max` [s] since the start."""
        counts = np.cumsum(self._counts)
        p50, p99 = (min(self._worst, _upper_edge(counts, share)) for share in (0.5, 0.99))
        return {"total_p50": p50, "total_p99": p99, "total_max": self._worst}


_LOG_GROWTH = math.log(GROWTH)


def _bin(late: float) -> int:
    if late <= RESOLUTION:
        return 0
    return min(BINS - 1, 1 + int(math.log(late / RESOLUTION) / _LOG_GROWTH))


def _upper_edge(counts: np.ndarray, share: float) -> float:
    """Return the upper edge [s] of the bin that holds this share of the ticks; counts are cumulative, shape (BINS,)."""
    if not counts[-1]:
        return 0.0
    return float(RESOLUTION * GROWTH ** int(np.searchsorted(counts, share * counts[-1])))
