"""Whether a thread that should turn ten times a second does, seen from inside and from the cycle beside it."""

import time

FROZEN = 0.25
"""A receive thread that turns after so long [s] did not come to run: two and a half times what it waits for frames."""
HANGS = 1.0
"""One that has not turned for so long [s] hangs,"""
HUNG_CYCLES = 3
"""provided that the cycle went on meanwhile: a process that was frozen as a whole has no thread that hangs."""


class ThreadWatch:
    """Goes by the machine's own clock: whether threads run is no matter of simulated time."""

    def __init__(self) -> None:
        self._turned = time.monotonic()
        self._seen = 0.0
        self._cycles = 0

    def start(self) -> None:
        """The thread starts now."""
        self._turned = time.monotonic()

    def turn(self) -> bool:
        """Called by the thread in every turn; whether it was frozen before."""
        before, self._turned = self._turned, time.monotonic()
        return self._turned - before > FROZEN

    @property
    def is_turning(self) -> bool:
        """Whether the thread turned lately."""
        return time.monotonic() - self._turned < HANGS

    def hangs(self) -> bool:
        """Asked once per cycle: whether the thread has not turned for long, though the cycle has."""
        self._cycles = 0 if self._turned != self._seen else self._cycles + 1
        self._seen = self._turned
        return self._cycles > HUNG_CYCLES and not self.is_turning
