"""Print end [monotonic s] and length [s] of every standstill of the machine until the parent is gone."""

import os
import time
from contextlib import suppress

PERIOD = 0.01
LEAST = 0.1
"""A machine that does not run a real-time process for this time [s] stands still."""

if __name__ == "__main__":
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
        parent, before = os.getppid(), time.monotonic()
        while os.getppid() == parent:
            time.sleep(PERIOD)
            now = time.monotonic()
            if now - before > LEAST:
                print(now, now - before, flush=True)
            before = now
