"""Keep all threads of a process on one core, as long as one core is enough.

Threads of one interpreter run one after the other, on any number of cores. On several cores a thread must wake a
sleeping core to run another thread, which then reads its data from the first core's caches. On one core the service of
a 25-element arm needs 26 % of it instead of 38 %, and its loops wait less for each other
(`python -m studies.stack.loops --without-bus`). Compiled code of several threads can use several cores at once, so a
process that needs more than one core, or does not keep its rates, gets all cores back.
"""

import contextlib
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

FULL = 0.7
"""A process that needs a larger share of a core gets all cores."""
CROWDED = 0.25
"""A process changes the core if others use its core for this share of time more than the least used one."""
PATIENCE = 60.0
"""A process that needed all cores keeps them for this time [s]."""
SHORTEST = 0.2
"""Shares are measured over at least this time [s]: the kernel counts in hundredths of a second."""
_TICKS = os.sysconf("SC_CLK_TCK")

Busy = dict[int, float]
"""This maps a core to its busy time [s]."""


def busy() -> Busy:
    """Return the busy time of every core since the machine was started; empty where /proc/stat cannot be read."""
    times: Busy = {}
    with contextlib.suppress(OSError):
        for line in Path("/proc/stat").read_text().splitlines():
            name, *ticks = line.split()
            if name.startswith("cpu") and name != "cpu":
                user, nice, system, _idle, _waiting, *other = map(int, ticks[:8])
                times[int(name[3:])] = (user + nice + system + sum(other)) / _TICKS
    return times


class OneCore:
    """A context manager that keeps all threads of this process on the core that others use least.

    Args:
        busy: Returns the busy time of every core.
        own: Returns the processor time of this process [s].
        clock: Returns the monotonic time [s].

    Attributes:
        core: Core of the process; None if it may run on all cores that were allowed at the start.
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

    def __exit__(self, *_: object) -> None:
        self._move(None)

    def look(self, is_slow: bool) -> None:
        """Choose the core anew; called once a second. `is_slow`: whether a loop does not keep its rate."""
        now, own = self._clock(), self._own()
        if len(self._allowed) < 2 or (self._read is not None and now - self._read[0] < SHORTEST):
            return
        before, self._read = self._read, (now, own, self._busy())
        if before is None:
            return
        elapsed, own_share = now - before[0], (own - before[1]) / (now - before[0])
        others = {core: (self._read[2].get(core, 0.0) - before[2].get(core, 0.0)) / elapsed for core in self._allowed}
        if self.core is not None:
            others[self.core] -= own_share
        least = min(others.values())
        if is_slow or own_share > FULL:
            self._free_until = now + PATIENCE
            self._move(None)
        elif now >= self._free_until and (self.core is None or others[self.core] > least + CROWDED):
            # A random choice, because services that are started together choose at the same moment.
            self._move(random.choice([core for core, share in others.items() if share <= least + CROWDED / 2]))

    def _move(self, core: int | None) -> None:
        if core == self.core:
            return
        self.core = core
        for entry in Path("/proc/self/task").iterdir():
            with contextlib.suppress(OSError):  # the thread has ended, or the core is no longer allowed
                os.sched_setaffinity(int(entry.name), self._allowed if core is None else {core})
