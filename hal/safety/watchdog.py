"""Watchdogs: the age of a command, measured from the cycle of its sample, and the time between two cycles."""

import math
from collections.abc import Sequence

import numpy as np

from hal.errors import CommandRefused


def checked(desired: np.ndarray, signal: str, elements: Sequence[str]) -> np.ndarray:
    """Return a copy of a command of a signal [its unit], shape (n,).

    Raises:
        CommandRefused: The size is wrong, or a value is not finite.
    """
    desired = np.array(desired, float)
    if desired.shape != (len(elements),):
        raise CommandRefused(f"A command of {signal} has {len(elements)} values, not shape {desired.shape}.")
    finite = np.isfinite(desired)
    if not finite.all():
        place = int(np.argmin(finite))
        raise CommandRefused(f"The command's {signal}.{elements[place]} is {desired[place]}; it must be finite.")
    return desired


class CommandWatchdog:
    """Times of the recent cycles, so that clocks of two processes are never compared."""

    def __init__(self, time_to_live: float, period: float) -> None:
        """Remember as many cycles of `period` [s] as fit into four times `time_to_live` [s], and at least 64."""
        self.time_to_live = time_to_live
        self._times = [-math.inf] * max(64, math.ceil(4 * time_to_live / period))
        self._newest = 0

    def note(self, cycle: int, now: float) -> None:
        """Note that cycle number `cycle` (one more than the last) is at monotonic time `now` [s]."""
        self._times[cycle % len(self._times)] = now
        self._newest = cycle

    def expiry(self, cycle: int, now: float) -> float:
        """Return the monotonic time [s] until which a command that answers `cycle` may be followed.

        Raises:
            CommandRefused: The cycle is unknown or too old.
        """
        newest = self._newest
        if not 0 < cycle <= newest:
            raise CommandRefused(
                f"The command answers cycle {cycle}, which has not been. The newest is {newest}; was the HAL restarted?"
            )
        oldest = newest - len(self._times) + 1
        age = math.inf if cycle < oldest else now - self._times[cycle % len(self._times)]
        if age > self.time_to_live:
            ago = f"{age * 1e3:.0f} ms" if math.isfinite(age) else f"{newest - cycle} cycles"
            raise CommandRefused(
                f"The command answers cycle {cycle}, {ago} ago; a command lives {self.time_to_live * 1e3:.0f} ms. "
                "Is the sender too slow, or reading old samples?"
            )
        return now - age + self.time_to_live


LONGEST_GAP = 0.2
"""An enabled robot stops if two cycles are farther apart than this [s]: it was not supervised meanwhile, and drives
without the HAL's heartbeat for 0.15 s have stopped by themselves."""


class CycleWatchdog:
    """Detector of gaps between cycles: a frozen process or a suspended machine."""

    def __init__(self) -> None:
        self._before = math.inf

    def problem(self, now: float) -> str:
        """Note a cycle at monotonic time `now` [s] and return the reason to stop the robot; empty without one."""
        gap, self._before = now - self._before, now
        if gap <= LONGEST_GAP:
            return ""
        return f"The cycle did not turn for {gap:.2f} s, longest allowed is {LONGEST_GAP:g} s. Was the HAL frozen?"
