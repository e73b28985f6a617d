"""Who watches the clock: the age of a command, taken from the cycle whose sample it answers, and the cycle itself."""

import math
from collections.abc import Sequence

import numpy as np

from hal.errors import CommandRefused


def checked(desired: np.ndarray, signal: str, elements: Sequence[str]) -> np.ndarray:
    """A copy of a command of a signal [its unit], shape (n,).

    Raises:
        CommandRefused: A wrong size, or not finite.
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
    """Remembers when each recent cycle was, so that no clock is compared between two processes."""

    def __init__(self, time_to_live: float, period: float) -> None:
        """Remember as many cycles of `period` [s] as fit into four times `time_to_live` [s], and at least 64."""
        self.time_to_live = time_to_live
        self._times = [-math.inf] * max(64, math.ceil(4 * time_to_live / period))
        self._newest = 0

    def note(self, cycle: int, now: float) -> None:
        """Cycle number `cycle` (one more than the one before) is happening at monotonic time `now` [s]."""
        self._times[cycle % len(self._times)] = now
        self._newest = cycle

    def expiry(self, cycle: int, now: float) -> float:
        """Monotonic time [s] until which a command that answers `cycle` may be followed.

        Raises:
            CommandRefused: No such cycle, or one too long ago.
        """
        newest = self._newest
        if not 0 < cycle <= newest:
            raise CommandRefused(
                f"The command answers cycle {cycle}, which has not been. The newest is {newest}; was the HAL restarted?"
            )
        oldest = newest - len(self._times) + 1
        age = math.inf if cycle < oldest else now - self._times[cycle % len(self._times)]
        if age > self.time_to_live:
            told = f"{age * 1e3:.0f} ms" if math.isfinite(age) else f"{newest - cycle} cycles"
            raise CommandRefused(
                f"The command answers cycle {cycle}, {told} ago; a command lives {self.time_to_live * 1e3:.0f} ms. "
                "Is the sender too slow, or reading old samples?"
            )
        return now - age + self.time_to_live


LONGEST_GAP = 0.2
"""A cycle of an enabled robot that comes so long [s] after the one before stops it: nobody looked after the robot
meanwhile, and drives that miss the HAL's heartbeat for 0.15 s have stopped by themselves."""


class CycleWatchdog:
    """Notices that the cycle itself did not turn: a frozen process, a machine that was suspended."""

    def __init__(self) -> None:
        self._before = math.inf

    def problem(self, now: float) -> str:
        """A cycle begins at monotonic time `now` [s]: why the robot must stop, in a sentence; empty if it need not."""
        gap, self._before = now - self._before, now
        if gap <= LONGEST_GAP:
            return ""
        return f"The cycle did not turn for {gap:.2f} s, longest allowed is {LONGEST_GAP:g} s. Was the HAL frozen?"
