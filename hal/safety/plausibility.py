"""Distrust of measured values that are physically not possible, whatever device sends them.

A value is implausible if it is outside of the possible range, if it changed faster than it can, or if no bit of it has
changed while the robot was commanded to move. An implausible value is not valid; it becomes valid again by itself.
"""

from collections.abc import Sequence
from typing import Self

import numpy as np

from hal.config import RobotConfig
from hal.device import Device
from hal.safety import feedback
from hal.safety.possible import Possible, possible

MOVED = 0.02
"""An element named like a commanded one must change when that one's set-point has moved by this part of its range."""
ALL_MOVED = 0.05
"""An element of another name must change when the set-points of half of the commanded elements have moved by this part
of their ranges."""
LOOK_EVERY = 0.02
"""Frozen values are searched for at this interval [s]."""
JUMP_BACK = 0.1
"""A value that jumps back to where it was within this time [s] is measured again at once: it was a single error."""
STAYS = 5.0
"""A value that jumped once, and stays where it is, is measured again after this time [s]: either it is wrong now, or it
was wrong before."""
JUMPS_FORGIVEN = 3
"""With more jumps than this within `return_after`, a value is not trusted although it is back where it was."""
LONG_AGO = -1e18
"""This time [s] is before the first measurement; it is finite, so that differences of times are numbers."""
OK, RANGE, JUMP, FROZEN = range(4)


class Plausibility:
    """Check of all measured elements, once per cycle, without a loop over elements. Not thread safe but for `texts`.

    Attributes:
        count: Number of implausible measurements so far.
    """

    def __init__(self, bounds: Possible, span: np.ndarray, period: float, quantity: str = "position") -> None:
        """Begin without measurements.

        Args:
            bounds: Possible values of n elements.
            span: Range of the position of each commanded element [its unit], shape (k,); inf without one.
            period: Period of a cycle [s].
            quantity: Commanded quantity: `position`, `velocity` or `effort`.
        """
        size = len(bounds.names)
        self.count = 0
        self._bounds, self._period = bounds, period
        self._quantity = quantity
        self._way = np.zeros(len(span))
        self._before = np.full(size, np.nan)  # newest measurement and its time, plausible or not
        self._received = np.full(size, LONG_AGO)
        self._good = np.full(size, np.nan)  # newest plausible measurement and its time
        self._good_at = np.full(size, LONG_AGO)
        self._is_trusted = np.ones(size, bool)
        self._has_doubts = self._is_marked = False
        self._calm_since = np.full(size, LONG_AGO)
        self._jumps = np.zeros(size, int)
        is_confirmed = bounds.return_after == 0.0  # by the next measurement, also after a pause
        self._stays = np.where(is_confirmed, 0.0, STAYS)
        self._longest = np.where(is_confirmed, period, np.inf)
        self._jumped_from = np.full(size, np.nan)
        self._stillness = Stillness(bounds, span, period)
        self._reason = np.full(size, OK)  # for which trust was lost, and the value that was wrong
        self._wrong = np.full(size, np.nan)
        self._state = np.full(size, OK)
        self._is_reset = False

    @classmethod
    def of(cls, config: RobotConfig, signals: Sequence[str], devices: Sequence[Device]) -> Self:
        """Prepare the check of all elements of some signals of a robot, in order."""
        quantity = next((device.command_quantity for device in devices if device.commands), "position")
        low, high = config.bounds(config.command.signal)
        span = high - low
        if quantity != "position":
            span = np.full(len(span), np.inf)
            for place in feedback.measured_ranges(config, feedback.quantities(config, devices), "position"):
                span[place.commanded] = place.high - place.low
        return cls(possible(config, signals, devices), span, 1.0 / config.rates.hal, quantity)

    def check(self, values: np.ndarray, received: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return whether each element may be used, shape (n,): valid and plausible; `valid` itself if all are.

        Args:
            values: Newest measurements [their units], shape (n,).
            received: Their arrival [monotonic s], shape (n,).
            valid: Whether each is fresh and finite, shape (n,).
        """
        if self._is_reset:
            self._is_reset = False
            self._stillness.reset()
        bounds, before = self._bounds, self._before
        since = received - self._received
        fresh = valid & (since > 0.0)
        change = np.abs(values - before)
        outside = fresh & ((values < bounds.low) | (values > bounds.high))
        jumped = fresh & (change > bounds.rate * (np.minimum(since, self._longest) + self._period))
        if self._has_doubts or (outside | jumped).any():
            self._doubt(values, received, fresh, outside, jumped)
        np.copyto(before, values, where=fresh)
        np.copyto(self._received, received, where=fresh)
        frozen = self._stillness.note(values, received, fresh & (change != 0.0))
        if not self._has_doubts and not self._stillness.is_any_frozen:
            if self._is_marked:
                self._state, self._is_marked = np.full_like(self._state, OK), False
            return valid
        usable: np.ndarray = valid & self._is_trusted & ~frozen
        self._state = np.where(self._is_trusted, np.where(frozen, FROZEN, OK), self._reason)
        self._is_marked = True
        self.count += int(np.count_nonzero(fresh & ~usable))
        return usable

    def reset(self) -> None:
        """Call no element frozen from the next check on; for any thread.

        A blocked motor makes a good position look frozen, and it cannot change until the motor moves again.
        """
        self._is_reset = True

    def command(self, set_point: np.ndarray | None) -> None:
        """Note the set-points that were sent in this cycle, shape (k,); None if none were sent.

        An effort says nothing about the motion, so with effort commands no value is called frozen.
        """
        if set_point is not None and self._quantity == "velocity":
            self._way = set_point = self._way + set_point * self._period
        self._stillness.command(None if self._quantity == "effort" else set_point)

    def _doubt(
        self, values: np.ndarray, received: np.ndarray, fresh: np.ndarray, outside: np.ndarray, jumped: np.ndarray
    ) -> None:
        """Take and give back trust: `outside` and `jumped` take it, a jump back or a calm time gives it back."""
        bounds, trusted = self._bounds, self._is_trusted
        np.copyto(self._good, self._before, where=trusted)
        np.copyto(self._good_at, self._received, where=trusted)
        calm = received - self._calm_since
        away = received - self._good_at
        self._jumps[trusted & (calm >= bounds.return_after) & ~jumped] = 0
        self._jumps += jumped
        is_near = np.abs(values - self._good) <= bounds.rate * (np.minimum(away, JUMP_BACK) + self._period)
        back = jumped & ~trusted & is_near & (away <= JUMP_BACK) & (self._jumps <= JUMPS_FORGIVEN)
        after = np.where(self._jumps == 1, self._stays, bounds.return_after)
        returned = fresh & ~outside & ~jumped & (calm >= after)
        np.copyto(self._jumped_from, self._good, where=jumped & trusted)
        np.copyto(self._wrong, values, where=jumped | outside)
        np.copyto(self._reason, JUMP, where=jumped)
        np.copyto(self._reason, RANGE, where=outside)
        np.copyto(self._calm_since, received, where=jumped | outside)
        self._is_trusted = np.where(outside | (jumped & ~back), False, trusted | back | returned)
        self._has_doubts = not self._is_trusted.all()

    def texts(self) -> dict[str, str]:
        """Return the reason for every implausible element, as `signal.element` -> sentence."""
        state, bounds = self._state.copy(), self._bounds
        texts = {}
        for index in np.flatnonzero(state != OK).tolist():
            name, value, wrong = bounds.names[index], self._before[index], self._wrong[index]
            if state[index] == RANGE:
                reason = (
                    f"read {wrong:.4g}, possible is {bounds.low[index]:.4g} to {bounds.high[index]:.4g}. "
                    "Is the sensor broken, its wire loose, its scale right?"
                )
            elif state[index] == JUMP:
                reason = (
                    f"jumped from {self._jumped_from[index]:.4g} to {wrong:.4g}; possible is a change of "
                    f"{bounds.rate[index] * self._period:.3g} per cycle. Does the sensor slip or its wire break?"
                )
            else:
                reason = (
                    f"reads {value:.6g} without a change of any bit while the robot is commanded to move. "
                    "Is the sensor frozen, or at an end of its range?"
                )
            texts[name] = f"'{name}' {reason}"
        return texts


class Stillness:
    """Check for values of which no bit changes while the robot is commanded to move."""

    def __init__(self, bounds: Possible, span: np.ndarray, period: float) -> None:
        """Begin without a set-point; `span` and `period` as for `Plausibility`."""
        self._after, self._unloaded = bounds.frozen_after, bounds.unloaded
        self._has_own = bounds.own >= 0
        self._own = np.where(self._has_own, bounds.own, 0)
        span = np.where(np.isfinite(span), span, 1.0)
        self._own_way, self._way = MOVED * span[self._own], ALL_MOVED * span
        self._others = np.flatnonzero(~self._has_own)
        size = len(bounds.names)
        self._start = np.full((size, len(span)), np.nan)
        """Set-points at the last change of a bit of each element."""
        self._moved_at = np.full(size, np.inf)
        self._has_changed = np.zeros(size, bool)
        self._is_frozen = np.zeros(size, bool)
        self.is_any_frozen = False
        """Whether any element is frozen, or was until its bits have just changed."""
        self._rows = np.arange(size)
        self._is_watching = bool(np.isfinite(self._after).any())
        self._set_point: np.ndarray | None = None
        self._every = max(1, round(LOOK_EVERY / period))
        self._count = 0

    def command(self, set_point: np.ndarray | None) -> None:
        """Note the set-points of this cycle; see `Plausibility.command`."""
        if set_point is None and self._set_point is not None:
            self._start[:] = np.nan
            self._moved_at[:] = np.inf
        self._set_point = set_point

    def reset(self) -> None:
        """Begin again, without a frozen element."""
        self._is_frozen, self.is_any_frozen = np.zeros_like(self._is_frozen), False
        self._moved_at[:] = np.inf
        self._start[:] = np.nan

    def note(self, values: np.ndarray, received: np.ndarray, changed: np.ndarray) -> np.ndarray:
        """Return whether each element is frozen, shape (n,), given the newest values and whether a bit changed."""
        if not self._is_watching:
            return self._is_frozen
        self._has_changed |= changed
        if self.is_any_frozen:
            self._is_frozen = self._is_frozen & ~changed
        self._count += 1
        if self._count % self._every == 0:
            self._look(values, received)
        return self._is_frozen

    def _look(self, values: np.ndarray, received: np.ndarray) -> None:
        """Compare the way of the set-points since the last change of each element with what should change it."""
        set_point, start, changed = self._set_point, self._start, self._has_changed
        self._moved_at[changed] = np.inf
        start[changed] = np.nan if set_point is None else set_point
        changed[:] = False
        if set_point is not None:
            np.copyto(start, set_point, where=np.isnan(start))
            way = np.abs(set_point - start)
            moved = self._has_own & (way[self._rows, self._own] > self._own_way)
            if self._others.size:
                moved[self._others] = 2 * np.count_nonzero(way[self._others] > self._way, axis=1) >= way.shape[1]
            np.copyto(self._moved_at, received, where=moved & np.isinf(self._moved_at))
        still = (received - self._moved_at > self._after) & (np.abs(values) > self._unloaded)
        self._is_frozen = self._is_frozen | still
        self.is_any_frozen = bool(self._is_frozen.any())
