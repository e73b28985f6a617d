"""Services that run inside of a test leave this process as they found it."""

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

SWITCH_INTERVAL = sys.getswitchinterval()


@pytest.fixture(autouse=True)
def ordinary_process() -> Iterator[None]:
    """A service in real-time scheduling takes all threads of its process along, its garbage and its interpreter too.

    Left so, the test process would run before the simulated hardware of later tests, and starve it.
    """
    yield
    sys.setswitchinterval(SWITCH_INTERVAL)
    gc.unfreeze()
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER:
        return
    for thread in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):
            os.sched_setscheduler(int(thread.name), os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
