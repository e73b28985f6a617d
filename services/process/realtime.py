"""Settings of the kernel and the interpreter that make loops punctual; each is tried, none is required."""

import contextlib
import ctypes
import gc
import logging
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

log = logging.getLogger(__name__)

SWITCH_INTERVAL = 0.0001
"""A Python thread may keep a loop waiting for this time [s]; Python's default of 5 ms is a whole cycle."""
START_PRIORITY = 1
"""The start of a service has this SCHED_FIFO priority, below that of every loop."""
STARTS_WITHIN = 5.0
"""A start has this priority for at most this time [s]."""
MOST_HEAPS = 2
"""All threads of a process share this number of heaps of the C library."""
_PR_SET_TIMERSLACK, _M_ARENA_MAX = 29, -8
_is_refusal_logged = threading.Event()


def prepare_process() -> None:
    """Let Python threads alternate quickly. Call once, at the start of a process that runs loops."""
    sys.setswitchinterval(SWITCH_INTERVAL)


def share_heaps() -> None:
    """Let all threads allocate from at most `MOST_HEAPS` heaps of the C library, where it knows this setting.

    By default it makes up to eight heaps per core, and each keeps the most that its threads ever needed: in a flood of
    messages a recorder grew for several floods (docs/results_running.md).
    """
    with contextlib.suppress(AttributeError):  # not the GNU library
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, MOST_HEAPS)


def freeze() -> None:
    """Exclude all objects of the start-up from garbage collection, so that its pauses stay short."""
    gc.collect()
    gc.freeze()


def prepare_thread(priority: int) -> str:
    """Give the calling thread exact timers and, if the system allows it, real-time scheduling.

    Args:
        priority: SCHED_FIFO priority (1 to 99, higher first); 0 leaves the thread in normal scheduling.

    Returns:
        `fifo` or `other`, the scheduling of the thread now. A refusal is logged once per process.
    """
    # Normal threads wake up to 50 us late so that timers can share an interrupt; 1 ns turns that off.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if not priority:
        return "other"
    return "fifo" if _use_fifo(0, priority) else "other"


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Run the start of a service before normal programs, if the system allows it.

    A start takes about 0.7 s of a core. On a busy machine a service that was killed would otherwise be absent for ten
    times as long. The loops of running services have higher priorities. Compiling takes longer than `STARTS_WITHIN`,
    and continues in normal scheduling.
    """
    thread = threading.get_native_id()
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(START_PRIORITY))
    except OSError:  # the loops report it
        yield
        return
    end = threading.Timer(STARTS_WITHIN, _use_other, (thread,))
    end.daemon = True
    end.start()
    try:
        yield
    finally:
        end.cancel()
        _use_other(thread)


def _use_other(thread: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def promote(prefix: str, priority: int) -> None:
    """Try real-time scheduling for the threads whose name begins with `prefix`."""
    for thread in threading.enumerate():
        if thread.name.startswith(prefix) and thread.native_id is not None:
            _use_fifo(thread.native_id, priority)


def promote_rest(priority: int) -> None:
    """Try real-time scheduling for every other thread of this process, zenoh's included.

    Otherwise the input and output of a punctual loop are delayed in threads that do not run: with two other busy
    processes on two cores, commands reached the HAL 100 ms late.
    """
    for entry in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):
            if os.sched_getscheduler(int(entry.name)) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER:
                _use_fifo(int(entry.name), priority)


@contextlib.contextmanager
def at_most(priority: int) -> Iterator[None]:
    """Run a block with at most this SCHED_FIFO priority; a thread in normal scheduling stays there."""
    policy, before = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(0).sched_priority
    if policy != os.SCHED_FIFO or before <= priority:
        yield
        return
    _use_fifo(0, priority)
    try:
        yield
    finally:
        _use_fifo(0, before)


def _use_fifo(thread: int, priority: int) -> bool:
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        if not _is_refusal_logged.is_set():
            _is_refusal_logged.set()
            log.warning(
                "No real-time scheduling (%s): loops are less punctual when the machine is busy. "
                "To allow it, give the user an rtprio limit, or the container CAP_SYS_NICE.",
                error.strerror,
            )
        return False
    return True
