"""Lock of the robot's state between the cycle and requests of other threads."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from hal.errors import CommandRefused

PATIENCE = 0.5
"""A request waits at most this time [s] for the end of a cycle."""


class CycleLock:
    """A lock for which the cycle waits without limit, and all other threads for a limited time."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    @contextmanager
    def cycle(self) -> Iterator[None]:
        """Hold the lock during a cycle."""
        with self._lock:
            yield

    @contextmanager
    def request(self) -> Iterator[None]:
        """Hold the lock during a request, between two cycles.

        Raises:
            CommandRefused: The cycle does not end within `PATIENCE`.
        """
        with self.within(PATIENCE) as is_free:
            if not is_free:
                raise CommandRefused("The HAL's cycle is stuck, so only `gemuco estop` is possible.")
            yield

    @contextmanager
    def within(self, patience: float) -> Iterator[bool]:
        """Hold the lock if the cycle ends within `patience` [s]; yield whether it did."""
        is_free = self._lock.acquire(timeout=patience)
        try:
            yield is_free
        finally:
            if is_free:
                self._lock.release()
