"""Several jobs at once, on all cores that this process may use: compiled code runs without the GIL."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from threading import Event
from typing import TypeVar

from gemuco.compiled.blas import one_thread

Found = TypeVar("Found")


def count() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def parts(total: int, most: int) -> list[slice]:
    """So many things cut into parts of at most `most`, and so that every core has one."""
    step = max(1, min(most, -(-total // count())))
    return [slice(begin, begin + step) for begin in range(0, max(total, 1), step)]


def run(jobs: Sequence[Callable[[], Found]], stop: Event | None = None) -> list[Found]:
    """What they return, in order.

    Args:
        jobs: Called from threads, as many at a time as there are cores; a single one in this thread.
        stop: Set when one raises, or this thread is interrupted; the others may end sooner for it, and are waited for.
    """
    if len(jobs) < 2 or count() < 2:
        return [job() for job in jobs]
    with one_thread(), ThreadPoolExecutor(min(count(), len(jobs))) as pool:
        running = [pool.submit(job) for job in jobs]
        try:
            wait(running, return_when=FIRST_EXCEPTION)
            for one in running:
                if one.done() and (error := one.exception()) is not None:
                    raise error
            return [one.result() for one in running]
        finally:
            if stop is not None:
                stop.set()
            pool.shutdown(cancel_futures=True)
