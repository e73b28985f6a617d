"""Time as an argument: the machine's clock, and one that a test moves by hand."""

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock for deadlines and ages, and the wall clock for stamps."""

    def monotonic(self) -> float:
        """Seconds from an arbitrary start; never goes back."""
        ...

    def now_ns(self) -> int:
        """Wall-clock time [ns since 1970]; for stamps only, never for deadlines."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Sleep until `monotonic()` reaches the deadline; return at once when it has passed."""
        ...


class BusClock(Clock, Protocol):
    """A clock by which one can also wait for an answer."""

    def wait(self, event: threading.Event, deadline: float) -> bool:
        """Sleep until the event is set, at most until the deadline [s]; whether it was set."""
        ...


class SystemClock:
    """The machine's own clocks."""

    monotonic = staticmethod(time.monotonic)
    """See `Clock.monotonic`; read once per received frame."""
    now_ns = staticmethod(time.time_ns)
    """See `Clock.now_ns`."""

    def sleep_until(self, deadline: float) -> None:
        """See `Clock.sleep_until`."""
        remaining = deadline - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)

    def wait(self, event: threading.Event, deadline: float) -> bool:
        """Sleep until the event is set, at most until `monotonic()` reaches the deadline; whether it was set."""
        return event.wait(max(deadline - time.monotonic(), 0.0))


class ManualClock:
    """A clock that only moves when told to, so that a test of time needs no time."""

    def __init__(self, start: float = 1000.0) -> None:
        self._now = start
        self._wall = 0.0
        self._moved = threading.Condition()

    def monotonic(self) -> float:
        """See `Clock.monotonic`."""
        return self._now

    def now_ns(self) -> int:
        """See `Clock.now_ns`."""
        return round((self._now + self._wall) * 1e9)

    def set_wall(self, ahead: float) -> None:
        """Set the wall clock to so much [s] ahead of the monotonic one, as somebody does who sets a machine's time."""
        self._wall = ahead

    def advance(self, duration: float) -> None:
        """Move time forward by `duration` [s] and wake whoever sleeps."""
        with self._moved:
            self._now += duration
            self._moved.notify_all()

    def sleep_until(self, deadline: float) -> None:
        """Block until another thread has advanced the clock to the deadline."""
        with self._moved:
            self._moved.wait_for(lambda: self._now >= deadline)

    def wait(self, event: threading.Event, deadline: float) -> bool:
        """Give those who may set the event 20 ms of real time, whatever the deadline; whether it was set."""
        return event.wait(0.02)
