"""Samples whose elements were measured at one time, although a camera reports later; and errors if they were not quite.

Stamps are rounded, and delays vary. An arm at 2 rad/s moves by 0.01 rad in 5 ms, which is several errors of a good
model. Such errors grow with the velocity and are zero at rest, so they are no sign of a lie, and no size that was
learned at rest or in slow motion has them.
"""

import math
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from gemuco.trust.config import BLOCK

WAIT = 0.3
"""After this time [s] without a frame, samples are used without the camera."""
GAP = 0.1
"""Between two samples that are further apart [s] nothing is interpolated."""
SLOW, SLOWEST = 0.03, 0.25
"""An element with a longer interval [s] between its values is slow; values further apart are not interpolated."""
LEARNED = 0.25
"""Share of the newest interval in the usual one."""
SAME = 1e-3
"""Times that differ by less than this [s] are of one value: stamps are rounded."""
MOST = 256
"""At most this number of samples, and of frames, is kept."""
TIMING = 0.005
"""Values of two signals that count as of one time are apart by a multiple of this time [s], which is learned."""


class Aligned:
    """Rows of all elements at the times of the camera's frames, those of the other sensors interpolated.

    An arm at 2 rad/s moves by 0.1 rad within the 50 ms after which a frame arrives: beside the newest joint angles a
    right camera looks wrong. The other sensors are read more often than the camera, so they are interpolated.
    """

    def __init__(self) -> None:
        self._rows: deque[tuple[float, np.ndarray]] = deque(maxlen=MOST)
        self._frames: deque[tuple[float, np.ndarray]] = deque(maxlen=MOST)
        self._latest = -math.inf
        self._has_frame = False
        """Whether the latest row had a frame."""

    def add(self, time: float, row: np.ndarray) -> None:
        """Add a sample without the camera; one that is not newer than the one before is ignored.

        Args:
            time: Time of measurement [s].
            row: Every element [its unit], shape (size,); NaN for those of the camera, and where not measured.
        """
        if not self._rows or time > self._rows[-1][0]:
            self._rows.append((time, row))

    def see(self, time: float, frame: np.ndarray) -> None:
        """Add a frame of the camera; the arguments are those of `add`, with NaN for the other elements."""
        if time > (self._frames[-1][0] if self._frames else self._latest):
            self._frames.append((time, frame))

    def take(self, now: float) -> list[np.ndarray]:
        """Return the new rows, oldest first, each of shape (size,)."""
        taken = []
        while self._frames and self._rows and self._frames[0][0] <= self._rows[-1][0]:
            time, frame = self._frames.popleft()
            row = self._at(time)
            if row is not None and time > self._latest:
                taken.append(np.where(np.isnan(row), frame, row))
                self._latest, self._has_frame = time, True
        while self._rows and now - self._rows[0][0] >= WAIT:
            time, row = self._rows.popleft()
            if time > self._latest + (WAIT if self._has_frame else 0.0):  # those between two frames are not used
                taken.append(row)
                self._latest, self._has_frame = time, False
        return taken

    def _at(self, time: float) -> np.ndarray | None:
        """Return the other sensors at a time, shape (size,); None if the samples around it are missing or far apart."""
        while len(self._rows) > 1 and self._rows[1][0] <= time:
            self._rows.popleft()
        first, before = self._rows[0]
        if time <= first:
            return before if time == first else None
        if len(self._rows) < 2:
            return None
        second, after = self._rows[1]
        if second - first > GAP:
            return None
        return np.asarray(before + (time - first) / (second - first) * (after - before))


class _Waiting(NamedTuple):
    """A row of which slow elements are not known yet.

    Attributes:
        time: Time of the row [s].
        row: Every element, shape (size,); NaN where it is not known.
        open: Whether each element may still become known, shape (size,).
    """

    time: float
    row: np.ndarray
    open: np.ndarray


class Interpolated:
    """Rows of all elements at the times of the samples, those that are read less often interpolated.

    A sample holds the newest value of every element. A message of a car comes every 0.1 s: at 1 rad/s the joint that
    is read in every cycle has moved by up to 0.1 rad since then, and beside such values a right one looks wrong. A row
    with a slow element waits until its next value; without slow elements none waits.
    """

    def __init__(self, size: int) -> None:
        """Prepare for rows of `size` elements."""
        self._at, self._values = np.full(size, np.nan), np.full(size, np.nan)
        self._interval = np.zeros(size)
        self._waiting: deque[_Waiting] = deque(maxlen=MOST)
        self._newest = -math.inf

    @property
    def is_late(self) -> bool:
        """Whether rows wait, because some elements are slow."""
        return bool((self._interval > SLOW).any())

    def add(self, time: float, row: np.ndarray, at: np.ndarray) -> None:
        """Add a sample; one that is not newer than the one before is ignored.

        Args:
            time: Time of the sample [s].
            row: Newest value of every element [its unit], shape (size,); NaN where not measured.
            at: Time at which each value was measured [s], shape (size,).
        """
        if time <= self._newest:
            return
        self._newest = time
        is_there = np.isfinite(row) & np.isfinite(at)
        step = at - self._at
        is_first = is_there & ~np.isfinite(step)
        is_new = is_there & (step > SAME)
        self._interval[is_new] += LEARNED * (np.minimum(step[is_new], SLOWEST) - self._interval[is_new])
        fits = is_new & (step <= SLOWEST)
        for waiting in self._waiting:
            known = waiting.open & fits & (self._at <= waiting.time) & (waiting.time <= at)
            if known.any():
                share = (waiting.time - self._at[known]) / step[known]
                waiting.row[known] = self._values[known] + share * (row[known] - self._values[known])
            waiting.open[:] &= ~(is_new & (at >= waiting.time))
        own = row.copy()
        is_open = is_there & (self._interval > SLOW) & (time - at > SAME)
        own[is_open] = np.nan
        self._waiting.append(_Waiting(time, own, is_open))
        self._at = np.where(is_new | is_first, at, np.where(is_there, self._at, np.nan))
        self._values = np.where(is_new | is_first, row, self._values)

    def take(self, now: float) -> list[tuple[float, np.ndarray]]:
        """Return the time [s] and values, shape (size,), of the rows that need not wait any longer, oldest first."""
        taken = []
        while self._waiting and (not self._waiting[0].open.any() or now - self._waiting[0].time >= WAIT):
            waiting = self._waiting.popleft()
            taken.append((waiting.time, waiting.row))
        return taken


class Shift(NamedTuple):
    """Changes of blocks if all elements of one signal were measured `TIMING` later, for every signal.

    Attributes:
        values: Changes of every column [standard deviations], shape (n, signals, columns).
        features: Changes of the features of the watch, shape (n, signals, features).
    """

    values: np.ndarray
    features: np.ndarray

    @classmethod
    def joined(cls, parts: Iterable["Shift"]) -> "Shift":
        """Return parts one after the other."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def changes(rows: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Return how far all elements of each signal move within `TIMING`, shape (signals, columns).

    The largest step from one sample to the next counts as the second largest: a jump does not excuse itself.

    Args:
        rows: Successive samples of one block, from the last one of the block before on, shape (samples, columns).
        signals: Number of the signal of each column, shape (columns,); negative for p.
    """
    owns = signals == np.unique(signals[signals >= 0])[:, None]
    steps = np.nan_to_num(np.diff(rows, axis=0))
    if len(steps) < 2:
        return np.zeros(owns.shape)
    second = np.sort(np.abs(steps), axis=0)[-2]
    velocity = np.clip(steps, -second, second).sum(axis=0) / BLOCK
    return np.asarray(owns * velocity * TIMING)
