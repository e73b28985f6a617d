"""A bare timer with the loops' priority: what the machine alone does to whoever must be punctual.

python timer.py RECORD RATE
"""

import ctypes
import os
import sys
import time
from pathlib import Path

import msgpack

WORTH = 0.002
"""Lateness [s] from which a tick is written down."""


def main(record: str, rate: float) -> None:
    ctypes.CDLL(None).prctl(29, 1, 0, 0, 0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    except OSError:
        print("no SCHED_FIFO", file=sys.stderr)
    due = time.monotonic()
    with Path(record).open("ab", buffering=0) as sink:
        while True:
            due += 1.0 / rate
            time.sleep(max(0.0, due - time.monotonic()))
            late = time.monotonic() - due
            if late > WORTH:
                sink.write(msgpack.packb([due, late]))
                due = max(due, time.monotonic() - 1.0 / rate)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
