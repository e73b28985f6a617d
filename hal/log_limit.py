"""A limit of log lines: a node that reports the same kind of problem thousands of times a second fills no disk."""

import logging
import math
import threading

EVERY = 1.0
"""Two lines of one kind are at least this long [s] apart."""


class LogLimit:
    """At most one line of each kind per `EVERY` seconds; the next line of this kind says how many were left out."""

    def __init__(self, log: logging.Logger) -> None:
        """Write to `log`; kinds are few and fixed, such as the states of a bus."""
        self._log = log
        self._lock = threading.Lock()
        self._kinds: dict[str, tuple[float, int]] = {}

    def line(self, level: int, kind: str, now: float, text: str) -> None:
        """Write a line, or only count it.

        Args:
            level: Level of the logging module.
            kind: Kind of the line.
            now: Monotonic time [s].
            text: The line.
        """
        with self._lock:
            last, left_out = self._kinds.get(kind, (-math.inf, 0))
            if now - last < EVERY:
                self._kinds[kind] = (last, left_out + 1)
                return
            self._kinds[kind] = (now, 0)
        more = f" ({left_out} more such lines in the last {now - last:.1f} s)" if left_out else ""
        self._log.log(level, "%s%s", text, more)
