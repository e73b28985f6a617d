"""What can be said of a bus: a state machine that is told what was seen and knows neither interface nor clock.

Receive thread and cycle both tell it; whoever only looks at the state needs no lock.
"""

import threading
import time
from collections.abc import Callable
from enum import StrEnum

from hal.protocols.error_frames import Controller, ErrorFrame

WORRY = 1.0
"""Something that went wrong once is over when it did not happen again for so long [s]."""
RECOVERY = 5.0
"""A controller that was in trouble has recovered when frames came for so long [s] without a word of it: some drivers
report the way down only."""


class BusState(StrEnum):
    """What a bus can do for us, worst last."""

    OK = "ok"
    WARNING = "warning"
    PASSIVE = "passive"
    BUS_OFF = "bus-off"
    GONE = "gone"
    """Not open, or nothing was heard since it was opened."""


UNUSABLE = (BusState.BUS_OFF, BusState.GONE)
_STATE_OF = {
    Controller.ACTIVE: BusState.OK,
    Controller.WARNING: BusState.WARNING,
    Controller.PASSIVE: BusState.PASSIVE,
    Controller.OFF: BusState.BUS_OFF,
}


class BusWatch:
    """The state of one bus.

    An interface that could be opened proves nothing: a bus is there once a frame was heard. A bus that was unusable for
    an instant, between two looks at `state`, is found by `losses`.
    """

    def __init__(self, changed: Callable[[BusState, str], None] = lambda state, text: None) -> None:
        """Start out gone; `changed` is called with every new state and its text."""
        self.state = BusState.GONE
        self.text = "Not opened yet."
        self.losses = 0
        """How often it became unusable."""
        self.lost_by = ""
        """Why it became unusable last."""
        self.error_counters: tuple[int, int] | None = None
        """Transmit and receive error counters that the controller last told."""
        self._changed = changed
        self._lock = threading.RLock()
        self._is_there = False
        self._controller = Controller.ACTIVE
        self._controller_text = ""
        self._controller_at = 0.0
        self._worry = ""
        self._worry_at = 0.0
        self._gone = self.text

    def opened(self, text: str) -> None:
        """The interface was opened, which says nothing of the bus yet; `text` says what to wait for."""
        with self._lock:
            self.error_counters = None
            self.lost(text)

    def lost(self, text: str) -> None:
        """The interface failed, was closed, or nothing was heard for too long."""
        with self._lock:
            self._is_there = False
            self._controller, self._worry = Controller.ACTIVE, ""
            self._gone = text
            self._settle()

    def heard(self, now: float) -> None:
        """A frame of another node has come at `now` [s]; need not be told while the state is ok."""
        with self._lock:
            self._is_there = True
            if self._controller is Controller.OFF or now - self._controller_at > RECOVERY:
                self._controller = Controller.ACTIVE  # a controller that is off the bus hears nothing
            if now - self._worry_at > WORRY:
                self._worry = ""
            self._settle()

    def error(self, frame: ErrorFrame, now: float) -> None:
        """An error frame has come at `now` [s]."""
        with self._lock:
            if frame.counters is not None:
                self.error_counters = frame.counters
            if frame.controller is not None:
                self._controller, self._controller_text, self._controller_at = frame.controller, frame.text, now
            if frame.text and self._controller is Controller.ACTIVE:
                self._worry, self._worry_at = frame.text, now
            self._settle()

    def worry(self, text: str, now: float) -> None:
        """Something is not as it should be, though frames come and go."""
        with self._lock:
            self._worry, self._worry_at = text, now
            self._settle()

    def _settle(self) -> None:
        before = self.state
        if not self._is_there and self._controller is not Controller.OFF:
            self.state, self.text = BusState.GONE, self._worry or self._gone
        elif self._controller is not Controller.ACTIVE:
            self.state, self.text = _STATE_OF[self._controller], self._controller_text
        elif self._worry:
            self.state, self.text = BusState.WARNING, self._worry
        else:
            self.state, self.text = BusState.OK, ""
        if self.state in UNUSABLE and before not in UNUSABLE:
            self.losses += 1
            self.lost_by = f"is {self.state}. {self.text}"
        if self.state is not before:
            self._changed(self.state, self.text)


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
