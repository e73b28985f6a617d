"""What the kernel says of a process, and bare timer loops to compare with: for benchmarks that run for long."""

import contextlib
import multiprocessing
import threading
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Self

from services.process.realtime import prepare_process, prepare_thread

TICKS_PER_SECOND = 100
"""Of the processor times in /proc; the same on every Linux that we know."""


def look(pid: int) -> dict[str, float]:
    """Memory that is resident and its own [MB], threads, open files, processor time [s] of a process that runs."""
    folder = Path(f"/proc/{pid}")
    told = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    shares = dict(line.split(":", 1) for line in (folder / "smaps_rollup").read_text().splitlines()[1:])
    own = sum(int(shares[name].split()[0]) for name in ("Private_Clean", "Private_Dirty"))
    times = (folder / "stat").read_text().rpartition(")")[2].split()
    return {
        "rss": int(told["VmRSS"].split()[0]) * 1024 / 1e6,
        "own": own * 1024 / 1e6,
        "threads": int(told["Threads"]),
        "files": len(list((folder / "fd").iterdir())),
        "cpu": (int(times[11]) + int(times[12])) / TICKS_PER_SECOND,
    }


def _tick_nothing(rate: float, priority: int, counted: dict[str, float]) -> None:
    """Wake at a rate [Hz] for ever; what was late is counted as `services.process.loop.Loop` counts."""
    prepare_thread(priority)
    period, start, index = 1.0 / rate, time.monotonic(), 0
    while True:
        index += 1
        behind = int((time.monotonic() - start) / period) - index
        if behind > 0:
            counted["skipped"] += behind
            index += behind
        deadline = start + index * period
        pause = deadline - time.monotonic()
        if pause > 0:
            time.sleep(pause)
        late = time.monotonic() - deadline
        counted["ticks"] += 1
        counted["late"] += late
        counted["worst"] = max(counted["worst"], late)


def _bare(loops: Mapping[str, tuple[float, int]], pipe: Connection) -> None:
    prepare_process()
    counted = {name: {"ticks": 0.0, "skipped": 0.0, "late": 0.0, "worst": 0.0} for name in loops}
    for name, (rate, priority) in loops.items():
        threading.Thread(target=_tick_nothing, args=(rate, priority, counted[name]), daemon=True).start()
    while pipe.recv() == "tell":
        pipe.send(counted)


class BareLoops:
    """Loops that do nothing, in a process of their own: how punctual the machine is for anybody.

    Args:
        loops: Name -> rate [Hz], SCHED_FIFO priority.
    """

    def __init__(self, loops: Mapping[str, tuple[float, int]]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process: SpawnProcess = context.Process(target=_bare, args=(dict(loops), other), daemon=True)

    def __enter__(self) -> Self:
        self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):  # it may have been ended already
            self._pipe.send("end")
        self._process.join()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid or 0

    def counted(self) -> dict[str, dict[str, Any]]:
        """Name -> `ticks`, `skipped`, sum of all lateness `late` [s], `worst` [s], since the start."""
        self._pipe.send("tell")
        found: dict[str, dict[str, Any]] = self._pipe.recv()
        return found
