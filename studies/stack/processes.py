"""Memory and processor time of a process, and bare timer loops beside which ours are judged."""

import contextlib
import multiprocessing
import os
import threading
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Self

from services.process.lateness import Lateness
from services.process.realtime import prepare_process, prepare_thread


def cpu(pid: int) -> float:
    """Return the processor time [s] of a process since its start."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def look(pid: int) -> dict[str, float]:
    """Return resident and own memory [MB], threads, open files and processor time [s] of a process."""
    folder = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    shares = dict(line.split(":", 1) for line in (folder / "smaps_rollup").read_text().splitlines()[1:])
    own = sum(int(shares[name].split()[0]) for name in ("Private_Clean", "Private_Dirty"))
    return {
        "rss": int(status["VmRSS"].split()[0]) * 1024 / 1e6,
        "own": own * 1024 / 1e6,
        "threads": int(status["Threads"]),
        "files": len(list((folder / "fd").iterdir())),
        "cpu": cpu(pid),
    }


class BareLoops:
    """Loops without work in a process of their own: they show how punctual the machine is.

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
        with contextlib.suppress(OSError):  # the process may have ended already
            self._pipe.send("end")
        self._process.join()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid or 0

    def counted(self) -> dict[str, dict[str, float]]:
        """Return name -> `ticks`, `skipped`, and lateness `total_p50`, `total_p99`, `total_max` [s] since the start."""
        self._pipe.send("count")
        counts: dict[str, dict[str, float]] = self._pipe.recv()
        return counts


class _BareLoop:
    """Endless loop that wakes at a rate [Hz] and counts as `services.process.loop.Loop` does."""

    def __init__(self, rate: float, priority: int) -> None:
        self._period, self._priority = 1.0 / rate, priority
        self._lateness = Lateness(1)
        self._ticks = self._skipped = 0
        threading.Thread(target=self._run, daemon=True).start()

    def counted(self) -> dict[str, float]:
        return {"ticks": self._ticks, "skipped": self._skipped, **self._lateness.total()}

    def _run(self) -> None:
        prepare_thread(self._priority)
        start, index = time.monotonic(), 0
        while True:
            index += 1
            behind = int((time.monotonic() - start) / self._period) - index
            if behind > 0:
                self._skipped += behind
                index += behind
            deadline = start + index * self._period
            pause = deadline - time.monotonic()
            if pause > 0:
                time.sleep(pause)
            self._lateness.add(time.monotonic() - deadline)
            self._ticks += 1


def _bare(loops: Mapping[str, tuple[float, int]], pipe: Connection) -> None:
    prepare_process()
    running = {name: _BareLoop(rate, priority) for name, (rate, priority) in loops.items()}
    while pipe.recv() == "count":
        pipe.send({name: loop.counted() for name, loop in running.items()})
