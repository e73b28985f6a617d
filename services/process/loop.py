"""A named loop at a fixed rate: absolute grid, late and skipped counted, never a burst."""

import logging
import math
import threading
from collections.abc import Callable

from hal.clock import Clock, SystemClock
from services.process.lateness import Lateness
from services.process.realtime import prepare_thread

log = logging.getLogger(__name__)

LOG_EVERY = 1.0
"""A tick that keeps failing is logged this often [s]."""
ERROR_NEWS = 5.0
"""How long [s] a failed tick is worth mentioning."""
KEPT = 0.9
"""Share of its rate below which a loop, beside one tick, is told as too slow."""
FULL = 0.9
"""Share of the time inside the tick from which on it is the tick that is too long, and not the machine that is busy."""
MARGIN = 0.1
"""A loop that follows what it works on begins this share of its period after that has come."""
EARLIER, LATER = 1 / 500, 4 / 500
"""By how much of a period such a loop moves at once: four of five times all has then come before, however it varies."""


class Grid:
    """Deadlines at multiples of a period from a start; a deadline that was slept through is skipped, not made up."""

    def __init__(self, period: float, start: float) -> None:
        self.period = period
        self.skipped = 0
        self._start = start
        self._index = 0

    @classmethod
    def aligned(cls, period: float, offset: float, now: float) -> "Grid":
        """From the last moment before now that lies `offset` [s] after a multiple of the period on the clock."""
        return cls(period, now - (now - offset) % period)

    def next(self, now: float) -> float:
        """The next deadline [s]: in the future, or less than one period past."""
        self._index += 1
        behind = math.floor((now - self._start) / self.period) - self._index
        if behind > 0:
            self.skipped += behind
            self._index += behind
        return self._start + self._index * self.period

    def follow(self, waited: float) -> None:
        """Move the start a little, so that what a tick works on has waited for `MARGIN` of a period when it begins.

        Args:
            waited: How long that had waited at the last tick [s]; any number of periods more means the same.
        """
        away = (waited / self.period - MARGIN + 0.5) % 1.0 - 0.5
        self._start += self.period * (LATER if away < 0.0 else -EARLIER)


class Loop:
    """Calls `tick` at a fixed rate from a thread of its own.

    A tick that overruns delays the next one, which counts as late; whole periods that it covered are skipped and
    counted. A tick that raises is counted and logged, and the loop goes on: whether that is safe is the tick's
    business.

    Args:
        name: Names the thread and the statistics.
        rate: Ticks per second [Hz].
        tick: What to do; takes nothing, returns nothing.
        clock: What time it is.
        priority: SCHED_FIFO priority to try, 0 for none.
        offset: When it ticks [s] after the multiples of its period on the clock: loops of one process share one
            interpreter, and those that begin at the same moment wait for each other.
        waited: Tells after a tick how long [s] what it worked on had waited when it began, None if that was nothing
            new; the grid moves slowly until that is short. By itself it stays where it is.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        tick: Callable[[], None],
        clock: Clock | None = None,
        priority: int = 0,
        offset: float = 0.0,
        waited: Callable[[], float | None] | None = None,
    ) -> None:
        self.name = name
        self.rate = rate
        self.scheduling = "other"
        """`fifo` when real-time scheduling was granted."""
        self.failed = 0
        """Ticks that raised."""
        self._tick = tick
        self._clock = clock or SystemClock()
        self._priority = priority
        self._offset = offset
        self._waited = waited
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._lateness = Lateness(round(rate))
        self._ticks = 0
        self._overruns = 0
        self._busy = 0.0
        self._grid: Grid | None = None
        self._counted = (self._clock.monotonic(), 0, 0.0)
        self._slow = ""
        self._error = ""
        self._failed_at = self._logged = -math.inf

    @property
    def error(self) -> str:
        """What the last tick that raised said; empty when that was long ago."""
        return self._error if self._clock.monotonic() - self._failed_at < ERROR_NEWS else ""

    @property
    def trouble(self) -> str:
        """What is wrong with this loop, in a sentence: `error`, or that it does not keep its rate; empty if nothing."""
        return self.error or self._slow

    @property
    def is_slow(self) -> bool:
        """Whether it did not keep its rate when `statistics` was last asked for."""
        return bool(self._slow)

    @property
    def done(self) -> int:
        """Ticks that ended without raising; where this stands still, the loop is stuck."""
        return self._ticks - self.failed

    def start(self) -> None:
        """Begin ticking; the first tick is at most one period from now."""
        if self._thread is not None:
            raise RuntimeError(f"Loop '{self.name}' was already started.")
        self._thread = threading.Thread(target=self._run, name=f"loop {self.name}", daemon=True)
        self._thread.start()

    def stop(self, patience: float | None = None) -> None:
        """Finish the tick in progress, if any, and end. Safe to call twice, and before `start`.

        Args:
            patience: How long [s] to wait for a tick that does not end; for ever if None.
        """
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(patience)

    def statistics(self) -> dict[str, float]:
        """How the loop keeps time, for `Status.loops`.

        Returns:
            `rate_wanted`; `rate` [Hz] and `busy` (share of the time inside the tick) since the last call; `late_p50`,
            `late_p99`, `late_max` [s] of the last second; `total_p50`, `total_p99`, `total_max` [s] since start;
            `ticks`, `overruns` (ticks that could not begin in time because the one before still ran), `skipped` and
            `failed` since start.
        """
        now = self._clock.monotonic()
        then, ticks, busy = self._counted
        self._counted = (now, self._ticks, self._busy)
        elapsed = max(now - then, 1e-9)
        self._slow = self._judged(self._ticks - ticks, self._busy - busy, elapsed)
        return {
            "rate_wanted": self.rate,
            "rate": (self._ticks - ticks) / elapsed,
            "busy": (self._busy - busy) / elapsed,
            **self._lateness.recent(),
            **self._lateness.total(),
            "ticks": self._ticks,
            "overruns": self._overruns,
            "skipped": self._grid.skipped if self._grid else 0,
            "failed": self.failed,
        }

    def _judged(self, ticks: int, busy: float, elapsed: float) -> str:
        """Why so many ticks in so long a time [s] are too few; empty if they are enough."""
        if self._grid is None or ticks >= KEPT * self.rate * elapsed - 1.0:
            return ""
        kept = f"Keeps {ticks / elapsed:.3g} of {self.rate:g} Hz"
        if busy > FULL * elapsed and ticks:
            return f"{kept}: a tick takes {1e3 * busy / ticks:.3g} ms, of {1e3 / self.rate:.3g} that it has."
        return f"{kept}, though a tick needs but {busy / elapsed:.0%} of the time. Is this machine busy?"

    def _run(self) -> None:
        self.scheduling = prepare_thread(self._priority)
        clock = self._clock
        now = clock.monotonic()
        self._grid = Grid.aligned(1.0 / self.rate, self._offset, now)
        self._counted = (now, 0, 0.0)
        while not self._stop.is_set():
            deadline = self._grid.next(now)
            if deadline < now:
                self._overruns += 1
            clock.sleep_until(deadline)
            if self._stop.is_set():
                return
            begun = clock.monotonic()
            self._lateness.add(begun - deadline)
            self._turn()
            now = clock.monotonic()
            self._busy += now - begun
            self._ticks += 1
            if self._waited is not None and (waited := self._waited()) is not None:
                self._grid.follow(waited)

    def _turn(self) -> None:
        try:
            self._tick()
        except Exception as error:
            self.failed += 1
            self._error = f"{type(error).__name__}: {error}"
            self._failed_at = now = self._clock.monotonic()
            if now - self._logged >= LOG_EVERY:
                self._logged = now
                log.exception("A tick of loop '%s' failed (%d so far)", self.name, self.failed)
