"""Values of the last 30 s for the plots, in bounded memory."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.watch.signal_rows import Kind, SignalRow
from services.watch.snapshot import RobotSnapshot, fresh

WINDOW = 30.0
"""The plots show this time [s]."""
RATE = 5.0
"""Points are added at this rate [Hz]."""
POINTS = round(WINDOW * RATE)
WAY = 60
"""The past of the parametric bias has at most this number of points."""
MOVED = 1e-3
"""The next point of the bias is at least this far from the last one."""


@dataclass(frozen=True, slots=True)
class Curves:
    """Curves of some elements.

    Attributes:
        time: Time relative to now [s], shape (k,).
        measured: Measured values, NaN where there are none, shape (elements, k).
        estimated: Estimated values, NaN where there are none, shape (elements, k).
        std: Expected errors of the estimates, NaN where there are none, shape (elements, k).
    """

    time: np.ndarray
    measured: np.ndarray
    estimated: np.ndarray
    std: np.ndarray


NOTHING = (np.nan, np.nan, np.nan)
"""This is a moment without a value: measured, estimated, std."""


class Trail:
    """Recent values, for one thread that adds and reads."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=POINTS)
        self._values: dict[str, deque[tuple[float, float, float]]] = {}
        self._scores: deque[tuple[float, float]] = deque(maxlen=POINTS)
        self._bias: deque[np.ndarray] = deque(maxlen=WAY)

    def add(self, now: float, snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> None:
        """Add the values of a moment [monotonic s]; calls above the rate are ignored."""
        if self._times and now - self._times[-1] < 0.9 / RATE:
            return
        present = {row.name: row for row in rows}
        for name in present.keys() - self._values.keys():
            self._values[name] = deque([NOTHING] * len(self._times), maxlen=POINTS)
        self._times.append(now)
        for name, values in self._values.items():
            row = present.get(name)
            if row is not None and row.kind is Kind.MEASURED:
                values.append((row.value, np.nan, np.nan))
            elif row is not None and row.kind is Kind.ESTIMATED:
                values.append((np.nan, row.value, row.std))
            else:
                values.append(NOTHING)
        anomaly = fresh(snapshot.anomaly)
        self._scores.append((np.nan, np.nan) if anomaly is None else (anomaly.score, anomaly.threshold))
        update = fresh(snapshot.update)
        if update is not None and len(update.bias) and np.isfinite(update.bias).all():
            self._add_bias(np.array(update.bias, float))

    def curves(self, names: Sequence[str], now: float) -> Curves:
        """Return the curves of elements (`signal.element`); NaN for unknown elements."""
        time = self._since(now)
        all_three = np.full((3, len(names), len(time)), np.nan)
        for index, name in enumerate(names):
            if values := self._values.get(name):
                all_three[:, index] = np.array(values).T
        return Curves(time, *all_three)

    def scores(self, now: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return time relative to now [s], anomaly score and threshold, each of shape (k,)."""
        scores = np.array(self._scores, float).reshape(-1, 2)
        return self._since(now), scores[:, 0], scores[:, 1]

    def bias(self) -> np.ndarray:
        """Return the past values of p, oldest first, shape (k, size)."""
        return np.array(self._bias)

    def _since(self, now: float) -> np.ndarray:
        return np.array(self._times, float) - now

    def _add_bias(self, bias: np.ndarray) -> None:
        if self._bias and len(self._bias[-1]) != len(bias):
            self._bias.clear()  # another model
        if not self._bias or float(np.linalg.norm(bias - self._bias[-1])) > MOVED:
            self._bias.append(bias)
