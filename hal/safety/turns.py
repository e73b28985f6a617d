"""Whose turn it is with the robot's state: the cycle's, or that of somebody who asks."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from hal.errors import CommandRefused

PATIENCE = 0.5
"""How long [s] a question waits for a cycle that does not end."""


class Turns:
    """A lock that the cycle waits for, and that nobody else waits for without end."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    @contextmanager
    def cycle(self) -> Iterator[None]:
        """The cycle's turn."""
        with self._lock:
            yield

    @contextmanager
    def question(self) -> Iterator[None]:
        """The turn of somebody who asks, between two cycles.

        Raises:
            CommandRefused: The cycle does not end.
        """
        with self.within(PATIENCE) as is_free:
            if not is_free:
                raise CommandRefused("The HAL's cycle is stuck, so it can be asked nothing but `gemuco estop`.")
            yield

    @contextmanager
    def within(self, patience: float) -> Iterator[bool]:
        """A turn if the cycle ends within `patience` [s], or else none; which of both."""
        is_free = self._lock.acquire(timeout=patience)
        try:
            yield is_free
        finally:
            if is_free:
                self._lock.release()
