"""SYNC and the HAL's heartbeat while nobody cycles, so that drives which watch for them do not report a lost master."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hal.clock import SystemClock
from hal.wire.budget import OWN_HEARTBEAT_RATE
from hal.wire.bus import Bus

PATIENCE = 0.01
"""How long [s] to wait for the nodes' answers, so that those of one SYNC are not taken for a second node's."""


@contextmanager
def pulse(buses: Sequence[Bus]) -> Iterator[threading.Lock]:
    """Keep the nodes of some open buses awake for as long as the context lasts; hold the lock to cycle oneself."""
    lock, over, clock = threading.Lock(), threading.Event(), SystemClock()

    def beat() -> None:
        while not over.wait(1.0 / OWN_HEARTBEAT_RATE):
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
        over.set()
        thread.join()
