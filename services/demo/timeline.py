"""Record of a story: truth, estimate, estimate with hidden signals, anomaly and applied command over time."""

import math
import threading
import time
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from gemuco.errors import SchemaError
from hal.errors import HalError
from services.client import Client
from services.errors import ServiceError
from services.wire.messages import Anomaly, Update

EVERY = 0.05
"""A row is sampled at this interval [s]."""
HIDDEN_EVERY = 4
"""Once in this many rows the model estimates the signal as if it were not measured."""


class Timeline:
    """Columns of a story, sampled in a thread.

    Columns are `time` [s since the start], `truth`, `value`, `estimated`, `source` (method and signals) and `stamp` [s
    since 1970] of the estimate of one signal, `applied` command, `score`, `threshold`, `is_anomaly` and `verdict`; and
    on a time axis of their own `hidden_time` and `hidden_error`, the norm of the model's estimate of the hidden signal
    minus the truth [its unit]. Missing values are NaN.
    """

    def __init__(self, client: Client, signal: str, size: int, commands: int, hide: Sequence[str]) -> None:
        """Prepare for a signal of `size` elements, and for queries of the model with the signals `hide` hidden."""
        self._client, self._signal, self._hide = client, signal, hide
        self._no_value, self._no_command = np.full(size, np.nan), np.full(commands, np.nan)
        self._columns: dict[str, list[object]] = defaultdict(list)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="timeline", daemon=True)
        self._start = time.monotonic()
        self.anomalies: list[tuple[float, Anomaly]] = []
        """Time [s] and message of every row that was an anomaly."""
        self.updates: list[tuple[float, Update]] = []
        """Time [s] and message of every state of the online update."""

    def __enter__(self) -> "Timeline":
        self._start = time.monotonic()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def now(self) -> float:
        """Return the time since the start [s]."""
        return time.monotonic() - self._start

    def column(self, name: str) -> np.ndarray:
        """Return a column so far, shape (rows,) or (rows, n)."""
        return np.array(list(self._columns[name]))

    def between(self, name: str, start: float, end: float, axis: str = "time") -> np.ndarray:
        """Return the rows of a column in a span of time [s]."""
        column = self.column(name)
        at = self.column(axis)[: len(column)]
        return column[: len(at)][(at >= start) & (at < end)]

    def stamp(self) -> float:
        """Return when the newest estimate was made [s since 1970]; 0 without one."""
        estimate = self._client.estimate()
        return 0.0 if estimate is None else 1e-9 * estimate.stamp_ns

    def marked(self, first: float, last: float) -> float:
        """Return the share of the values made in a span of time [s since 1970] that was marked as estimated, 0 of none.

        A row may be late on a busy machine. What it shows was made at its stamp.
        """
        value, estimated = (self.between(name, first, last, "stamp") for name in ("value", "estimated"))
        seen = estimated[np.isfinite(value)]
        return float((seen > 0).mean()) if seen.size else 0.0

    def _run(self) -> None:
        row = 0
        while not self._stop.wait(max(0.0, row * EVERY - self.now())):
            self._sample()
            if row % HIDDEN_EVERY == 0:
                self._query_hidden()
            row = max(row + 1, math.floor(self.now() / EVERY))

    def _sample(self) -> None:
        truth, estimate = self._client.truth(), self._client.estimate()
        anomaly, applied = self._client.anomaly(), self._client.applied()
        row = {
            "truth": self._no_value if truth is None else truth.values[self._signal],
            "value": self._no_value if estimate is None else estimate.values[self._signal],
            "estimated": self._no_value if estimate is None else estimate.estimated[self._signal].astype(float),
            "stamp": math.nan if estimate is None else 1e-9 * estimate.stamp_ns,
            "source": "" if estimate is None else f"{estimate.method[self._signal]} {estimate.mask[self._signal]}",
            "applied": self._no_command if applied is None else applied.values,
            "score": math.nan if anomaly is None else anomaly.score,
            "threshold": math.nan if anomaly is None else anomaly.threshold,
            "is_anomaly": anomaly is not None and anomaly.is_anomaly,
            "verdict": "" if anomaly is None else anomaly.verdict,
        }
        update = self._client.update()
        if update is not None and (not self.updates or update is not self.updates[-1][1]):
            self.updates.append((self.now(), update))
        if anomaly is not None and anomaly.is_anomaly:
            self.anomalies.append((self.now(), anomaly))
        for name, value in row.items():
            self._columns[name].append(value)
        self._columns["time"].append(self.now())

    def _query_hidden(self) -> None:
        try:
            error = hidden_error(self._client, self._signal, self._hide)
        except (ServiceError, SchemaError, HalError):
            error = self._no_value
        self._columns["hidden_error"].append(float(np.linalg.norm(error)))
        self._columns["hidden_time"].append(self.now())


def hidden_error(client: Client, signal: str, hide: Sequence[str]) -> np.ndarray:
    """Return a signal's estimate with some signals hidden, minus the truth [unit], shape (n,).

    All are NaN if the truth is not known, or if anything else is missing: while other sensors are late, the estimate
    shows what they lack, not what the model knows.
    """
    estimate, truth = client.estimate(hide=hide), client.truth()
    assert estimate is not None  # without some signals the model estimates anew
    value = np.asarray(estimate.values[signal], float)
    is_whole = not any(part.any() for name, part in estimate.estimated.items() if name not in hide)
    return value - truth.values[signal] if truth is not None and is_whole else np.full(len(value), np.nan)
