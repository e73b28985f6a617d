"""The age of a command, taken from the cycle whose sample it answers."""

import math

from hal.errors import CommandRefused


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
