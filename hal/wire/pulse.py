"""SYNC and heartbeat of the HAL without a cycle, so that drives which expect them do not report a lost master."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hal.clock import SystemClock
from hal.wire.budget import OWN_HEARTBEAT_RATE
from hal.wire.contract import Wire

PATIENCE = 0.01
"""Nodes have this time [s] to answer a SYNC; an answer after the next SYNC would look like that of a second node."""


@contextmanager
def pulse(buses: Sequence[Wire]) -> Iterator[threading.Lock]:
    """Send SYNC and heartbeat on open buses while the context lasts; hold the yielded lock to run own cycles."""
    lock, stopping, clock = threading.Lock(), threading.Event(), SystemClock()

    def beat() -> None:
        while not stopping.wait(1.0 / OWN_HEARTBEAT_RATE):
            with lock:
                start = clock.monotonic()
                for bus in buses:
                    bus.begin()
                    bus.sync(start)
                for bus in buses:
                    bus.wait(start + PATIENCE)

    thread = threading.Thread(target=beat, name="pulse", daemon=True)
    thread.start()
    try:
        yield lock
    finally:
        stopping.set()
        thread.join()
