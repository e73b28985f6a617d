"""Count of the estimates of one robot at a remote client."""

import threading
import time
from typing import Any

import numpy as np


class Arrivals:
    """Counter of the estimates of one robot, of lost estimates, and of pauses between estimates.

    Args:
        gap: A longer pause [s] between two estimates is a gap.
    """

    def __init__(self, gap: float) -> None:
        self._gap = gap
        self._news = threading.Condition()
        self._estimated: dict[str, np.ndarray] = {}
        self.methods: dict[str, str] = {}
        """Signal -> method of the newest estimate."""
        self.restart()

    def restart(self) -> None:
        """Restart the count; a pause before the restart is not counted."""
        self._newest: tuple[int, int, float] | None = None
        self.arrived = self.lost = self.gaps = 0
        self.longest = 0.0

    def add(self, message: dict[str, Any]) -> None:
        """Count one estimate."""
        now = time.monotonic()
        is_same = self._newest is not None and self._newest[1] == message["boot"]
        if self._newest is not None and is_same and message["seq"] <= self._newest[0]:
            return  # played again
        self.arrived += 1
        if self._newest is not None and is_same:
            self.lost += message["seq"] - self._newest[0] - 1
            pause = now - self._newest[2]
            self.gaps += pause > self._gap
            self.longest = max(self.longest, pause)
        self._newest = (message["seq"], message["boot"], now)
        self.methods = message["method"]
        elements, start = np.frombuffer(message["estimated"], "?"), 0
        with self._news:
            for signal, count in message["elements"].items():
                self._estimated[signal] = elements[start : start + count]
                start += count
            self._news.notify_all()

    def wait(self, signal: str, element: int, is_estimated: bool, timeout: float) -> float:
        """Return the time [s] until an element is estimated, or measured; NaN if it takes longer than `timeout` [s]."""

        def is_there() -> bool:
            return signal in self._estimated and bool(self._estimated[signal][element]) == is_estimated

        begun = time.monotonic()
        with self._news:
            return time.monotonic() - begun if self._news.wait_for(is_there, timeout) else float("nan")
