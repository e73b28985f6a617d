"""Keeps a process on one core, where that is enough for it.

Threads that share an interpreter run one after the other on however many cores. On several they only pay for it: to
wake another one a thread has to interrupt a core that sleeps, and what it hands over has to come from that core's
caches. On one core the service of a 25-element arm takes 26 % of it in place of 38 %, and its loops wait less for each
other (`python -m studies.stack.loops --without-bus`). Compiled code of several threads could run at once on several; so
a process that needs more than a core, or does not keep its rates, gets all of them back.
"""

import contextlib
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

FULL = 0.7
"""Share of a core from which on a process is not kept there."""
CROWDED = 0.25
"""A core on which others run for so much more [share of the time] than on another one is left for that."""
PATIENCE = 60.0
"""How long [s] a process that had to have all cores keeps them."""
SHORTEST = 0.2
"""Shares are not taken over less time [s]: the kernel counts in hundredths of a second."""
_TICKS = os.sysconf("SC_CLK_TCK")

Busy = dict[int, float]
"""Core -> time [s] it has worked."""


def busy() -> Busy:
    """How long every core has worked since the machine was started; nothing where the system does not tell."""
    found: Busy = {}
    try:
        lines = Path("/proc/stat").read_text().splitlines()
    except OSError:
        return found
    for line in lines:
        name, *ticks = line.split()
        if not name.startswith("cpu"):
            break
        if name != "cpu":
            user, nice, system, _idle, _waiting, *other = map(int, ticks[:8])
            found[int(name[3:])] = (user + nice + system + sum(other)) / _TICKS
    return found


class OneCore:
    """Keeps all threads of this process on the core where others run least; a context manager that ends by letting go.

    Args:
        busy: Tells how long every core has worked.
        own: Tells how long this process has.
        clock: Tells the time [s].

    Attributes:
        core: Where the process is kept; None if it may run anywhere that it was allowed to when this was made.
    """

    def __init__(
        self,
        busy: Callable[[], Busy] = busy,
        own: Callable[[], float] = time.process_time,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.core: int | None = None
        self._busy, self._own, self._clock = busy, own, clock
        self._allowed = os.sched_getaffinity(0)
        self._free_until = -float("inf")
        self._read: tuple[float, float, Busy] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._go(None)

    def look(self, is_slow: bool) -> None:
        """Look again where to be; from time to time, once a second.

        Args:
            is_slow: Whether a loop of the process does not keep its rate.
        """
        now, own = self._clock(), self._own()
        if len(self._allowed) < 2 or (self._read is not None and now - self._read[0] < SHORTEST):
            return
        before, self._read = self._read, (now, own, self._busy())
        if before is None:
            return
        elapsed, mine = now - before[0], (own - before[1]) / (now - before[0])
        others = {core: (self._read[2].get(core, 0.0) - before[2].get(core, 0.0)) / elapsed for core in self._allowed}
        if self.core is not None:
            others[self.core] -= mine
        least = min(others.values())
        if is_slow or mine > FULL:
            self._free_until = now + PATIENCE
            self._go(None)
        elif now >= self._free_until and (self.core is None or others[self.core] > least + CROWDED):
            # At random, for services that are started together look at the same moment.
            self._go(random.choice([core for core, share in others.items() if share <= least + CROWDED / 2]))

    def _go(self, core: int | None) -> None:
        if core == self.core:
            return
        self.core = core
        for entry in Path("/proc/self/task").iterdir():
            with contextlib.suppress(OSError):  # the thread has ended meanwhile, or the core was taken from us
                os.sched_setaffinity(int(entry.name), self._allowed if core is None else {core})
