"""A named loop at a fixed rate on an absolute grid. Late and skipped ticks are counted; there is never a burst."""

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
"""The error of a failed tick is reported for this time [s]."""
KEPT = 0.9
"""A loop that keeps less than this share of its rate, less one tick, is reported as too slow."""
FULL = 0.9
"""If the ticks of a slow loop take more than this share of the time, they are too long; else the machine is busy."""
MARGIN = 0.1
"""A loop that follows its input begins this share of its period after the input has arrived."""
EARLIER, LATER = 1 / 500, 4 / 500
"""Such a loop moves by these shares of its period per tick, so that in four of five ticks the input is there."""


class Grid:
    """Deadlines at multiples of a period from a start; a missed deadline is skipped."""

    def __init__(self, period: float, start: float) -> None:
        self.period = period
        self.skipped = 0
        self._start = start
        self._index = 0

    @classmethod
    def aligned(cls, period: float, offset: float, now: float) -> "Grid":
        """Make a grid that starts at the last moment `offset` [s] after a multiple of the period on the clock."""
        return cls(period, now - (now - offset) % period)

    def next(self, now: float) -> float:
        """Return the next deadline [s]: in the future, or less than one period past."""
        self._index += 1
        behind = math.floor((now - self._start) / self.period) - self._index
        if behind > 0:
            self.skipped += behind
            self._index += behind
        return self._start + self._index * self.period

    def follow(self, waited: float) -> None:
        """Move the start a little, so that the input of a tick arrives `MARGIN` of a period before it.

        Args:
            waited: Waiting time of the input at the last tick [s], modulo the period.
        """
        deviation = (waited / self.period - MARGIN + 0.5) % 1.0 - 0.5
        self._start += self.period * (LATER if deviation < 0.0 else -EARLIER)


class Loop:
    """A thread that calls `tick` at a fixed rate.

    A tick that overruns delays the next one, which counts as late; whole periods that it covered are skipped and
    counted. A tick that raises is counted and logged, and the loop continues; the tick must make that safe.

    Args:
        name: Name of the thread and of the statistics.
        rate: Ticks per second [Hz].
        tick: Function to call.
        clock: Source of time.
        priority: SCHED_FIFO priority to try, 0 for none.
        offset: Time [s] from the multiples of the period on the clock to the ticks. Loops of one process share one
            interpreter, and loops that begin at the same moment wait for each other.
        waited: Returns after a tick the waiting time [s] of its input when it began; None if the input was not new. The
            grid moves slowly until that time is short. Without this function the grid does not move.
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
        """This is `fifo` when real-time scheduling was granted."""
        self.failed = 0
        """This is the number of ticks that raised."""
        self.tick = tick
        self._clock = clock or SystemClock()
        self._priority = priority
        self.offset = offset
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
        """Error of the last tick that raised; empty after `ERROR_NEWS`."""
        return self._error if self._clock.monotonic() - self._failed_at < ERROR_NEWS else ""

    @property
    def trouble(self) -> str:
        """Problem of this loop in one sentence: `error`, or a rate that is not kept; empty without a problem."""
        return self.error or self._slow

    @property
    def is_slow(self) -> bool:
        """Whether it did not keep its rate at the last call of `statistics`."""
        return bool(self._slow)

    @property
    def done(self) -> int:
        """Number of ticks that did not raise; if it does not grow, the loop is stuck."""
        return self._ticks - self.failed

    def start(self) -> None:
        """Start the thread; the first tick is at most one period from now."""
        if self._thread is not None:
            raise RuntimeError(f"Loop '{self.name}' was already started.")
        self._thread = threading.Thread(target=self._run, name=f"loop {self.name}", daemon=True)
        self._thread.start()

    def stop(self, patience: float | None = None) -> None:
        """End after the tick in progress. Safe to call twice, and before `start`.

        Args:
            patience: Longest wait [s] for the tick in progress; unlimited if None.
        """
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(patience)

    def statistics(self) -> dict[str, float]:
        """Return the timing of the loop, for `Status.loops`.

        Returns:
            `rate_wanted`; `rate` [Hz] and `busy` (share of the time inside the tick) since the last call; `late_p50`,
            `late_p99`, `late_max` [s] of the last second; `total_p50`, `total_p99`, `total_max` [s] since start;
            `ticks`, `overruns` (ticks that began late because the one before still ran), `skipped` and `failed` since
            start.
        """
        now = self._clock.monotonic()
        before, ticks, busy = self._counted
        self._counted = (now, self._ticks, self._busy)
        elapsed = max(now - before, 1e-9)
        self._slow = self._slowness(self._ticks - ticks, self._busy - busy, elapsed)
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

    def _slowness(self, ticks: int, busy: float, elapsed: float) -> str:
        """Return the reason for too few ticks in the elapsed time [s]; empty if they are enough."""
        if self._grid is None or ticks >= KEPT * self.rate * elapsed - 1.0:
            return ""
        kept = f"Keeps {ticks / elapsed:.3g} of {self.rate:g} Hz"
        if busy > FULL * elapsed and ticks:
            return f"{kept}: a tick takes {1e3 * busy / ticks:.3g} ms, the period is {1e3 / self.rate:.3g} ms."
        return f"{kept}, although the ticks take only {busy / elapsed:.0%} of the time. Is this machine busy?"

    def _run(self) -> None:
        self.scheduling = prepare_thread(self._priority)
        clock = self._clock
        now = clock.monotonic()
        self._grid = Grid.aligned(1.0 / self.rate, self.offset, now)
        self._counted = (now, 0, 0.0)
        while not self._stop.is_set():
            deadline = self._grid.next(now)
            if deadline < now:
                self._overruns += 1
            clock.sleep_until(deadline)
            if self._stop.is_set():
                return
            start = clock.monotonic()
            self._lateness.add(start - deadline)
            self._try_tick()
            now = clock.monotonic()
            self._busy += now - start
            self._ticks += 1
            if self._waited is not None and (waited := self._waited()) is not None:
                self._grid.follow(waited)

    def _try_tick(self) -> None:
        try:
            self.tick()
        except Exception as error:
            self.failed += 1
            self._error = f"{type(error).__name__}: {error}"
            self._failed_at = now = self._clock.monotonic()
            if now - self._logged >= LOG_EVERY:
                self._logged = now
                log.exception("A tick of loop '%s' failed (%d so far)", self.name, self.failed)
