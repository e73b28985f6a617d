"""Time as an argument: the machine's clock, and one that a test moves by hand."""

import threading
import time
from typing import Protocol

from typing_extensions import override


class Clock(Protocol):
    """A monotonic clock for deadlines and ages, and the wall clock for stamps."""

    def monotonic(self) -> float:
        """Return seconds from an arbitrary start; never goes back."""
        ...

    def now_ns(self) -> int:
        """Return the wall-clock time [ns since 1970]; for stamps only, never for deadlines."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Sleep until `monotonic()` reaches the deadline; return at once when it has passed."""
        ...


class BusClock(Clock, Protocol):
    """A clock that can also wait for an event."""

    def wait(self, event: threading.Event, deadline: float) -> bool:
        """Sleep until the event is set or the deadline [s] is reached, and return whether it was set."""
        ...


class SystemClock(BusClock):
    """The machine's own clocks."""

    monotonic = staticmethod(time.monotonic)
    now_ns = staticmethod(time.time_ns)

    @override
    def sleep_until(self, deadline: float) -> None:
        remaining = deadline - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)

    @override
    def wait(self, event: threading.Event, deadline: float) -> bool:
        return event.wait(max(deadline - time.monotonic(), 0.0))


class ManualClock(BusClock):
    """A clock that a test moves by hand, so that a test of time needs no time."""

    def __init__(self, start: float = 1000.0) -> None:
        self._now = start
        self._wall = 0.0
        self._moved = threading.Condition()

    @override
    def monotonic(self) -> float:
        return self._now

    @override
    def now_ns(self) -> int:
        return round((self._now + self._wall) * 1e9)

    def set_wall(self, ahead: float) -> None:
        """Set the difference of the wall clock and the monotonic clock [s]."""
        self._wall = ahead

    def advance(self, duration: float) -> None:
        """Move time forward by `duration` [s] and wake sleeping threads."""
        with self._moved:
            self._now += duration
            self._moved.notify_all()

    @override
    def sleep_until(self, deadline: float) -> None:
        with self._moved:
            self._moved.wait_for(lambda: self._now >= deadline)

    @override
    def wait(self, event: threading.Event, deadline: float) -> bool:
        """Wait 20 ms of real time at most, regardless of the deadline, and return whether the event was set."""
        return event.wait(0.02)
