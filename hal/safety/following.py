"""Comparison of each drive's measurement with the set-points that it was sent: a drive that does not follow is a fault.

A drive may report that it is enabled although it does not move: its statusword is stuck, its power stage is off, its
brake is closed, or its encoder has jumped. Only the difference between set-point and measurement shows this.
"""

from collections.abc import Iterable

import numpy as np

from hal.config import RobotConfig, per_element
from hal.device import Device
from hal.safety.feedback import Arrays

TOLERANCES = {"position": 0.05, "velocity": 0.25, "effort": 0.5}
"""The default tolerance is this part of the range of a position, or of the largest velocity or effort."""
PERSISTS = 0.1
"""A drive does not follow if it is beyond the tolerance, and comes no nearer, for this time [s]. Single wrong frames do
not matter then, and a drive may take its time for a far set-point."""
NEARER = 0.05
"""A drive comes nearer if it approaches by this part of the tolerance."""


class Following:
    """Monitor of all commanded elements in the commanded quantity, once per cycle."""

    def __init__(self, config: RobotConfig, devices: Iterable[Device], quantity: str) -> None:
        """Prepare.

        Args:
            config: The robot file.
            devices: The drives; the `compliance` of each extends the default tolerance.
            quantity: Commanded quantity: `position`, `velocity` or `effort`.

        Raises:
            ValueError: `following_error` has a wrong number of values.
        """
        self._signal = signal = config.command.signal
        self._elements = config.signals[signal].elements
        size = len(self._elements)
        low, high = config.bounds(signal)
        scale = high - low if quantity == "position" else np.maximum(np.abs(low), np.abs(high))
        owner = {element: device for device in devices for element in device.commands}
        drives = [owner.get(f"{signal}.{element}") for element in self._elements]
        give = np.array([device.compliance if device else 0.0 for device in drives])
        given = per_element(config.command.following_error, size, "command.following_error")
        default = np.maximum(TOLERANCES[quantity] * scale, give)
        self._tolerance = np.where(np.isnan(given), default, given)
        self._step = np.where(np.isfinite(self._tolerance), NEARER * self._tolerance, 0.0)
        self._names = [
            device.name if device else element for device, element in zip(drives, self._elements, strict=True)
        ]
        self._lag = config.command.following_lag
        self._recent = np.full((max(2, round(self._lag * config.rates.hal)), size), np.nan)
        self._newest = self._recent[0]
        self._place = 0
        self._is_active = False
        self._since = np.full(size, np.inf)
        self._nearest = np.full(size, np.inf)

    def note(self, set_point: np.ndarray | None) -> None:
        """Note the set-points of this cycle [unit of the commanded signal], shape (n,); None if none were sent."""
        if set_point is None:
            self._is_active = False
            return
        if not self._is_active:
            self._is_active = True
            self._recent[:] = set_point
            self._since[:] = np.inf
        self._recent[self._place] = self._newest = set_point
        self._place = (self._place + 1) % len(self._recent)

    def problem(self, measured: Arrays, now: float) -> str:
        """Return the drive that does not follow, as a sentence; empty without one.

        Args:
            measured: Newest measurements; NaN where there is none, which neither ends nor begins a difference.
            now: Monotonic time [s].
        """
        if not self._is_active:
            return ""
        values = measured[self._signal]
        if (np.abs(values - self._newest) <= self._tolerance).all():
            self._since[:] = np.inf
            return ""
        low, high = self._recent.min(axis=0), self._recent.max(axis=0)
        distance = np.maximum(low - values, values - high)
        beyond = distance > self._tolerance
        within = distance <= self._tolerance
        self._since[within] = np.inf
        nearer = beyond & (np.isinf(self._since) | (distance < self._nearest - self._step))
        np.copyto(self._since, now, where=nearer)
        np.copyto(self._nearest, distance, where=nearer)
        late = np.flatnonzero(now - self._since > PERSISTS)
        if not late.size:
            return ""
        index = int(late[0])
        return (
            f"'{self._names[index]}' does not follow: {self._signal}.{self._elements[index]} is {values[index]:.4g}, "
            f"its set-points of the last {self._lag:g} s are {low[index]:.4g} to {high[index]:.4g}. Is it blocked or "
            "its brake closed, is its power stage on, is its encoder right?"
        )
