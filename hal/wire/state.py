"""State machine of a bus, without access to interface or clock.

Receive thread and cycle both report events to it. Reading the state needs no lock.
"""

import threading
import time
from collections.abc import Callable
from enum import StrEnum

from hal.protocols.error_frames import Controller, ErrorFrame

WORRY = 1.0
"""A problem is over if it did not occur again for this time [s]."""
RECOVERY = 5.0
"""A controller has recovered if frames arrived for this time [s] without a new error, because some drivers do not
report recovery."""


class BusState(StrEnum):
    """State of a bus, worst last."""

    OK = "ok"
    WARNING = "warning"
    PASSIVE = "passive"
    BUS_OFF = "bus-off"
    GONE = "gone"
    """The bus is not open, or no frame was received since it was opened."""


UNUSABLE = (BusState.BUS_OFF, BusState.GONE)
_STATE_OF = {
    Controller.ACTIVE: BusState.OK,
    Controller.WARNING: BusState.WARNING,
    Controller.PASSIVE: BusState.PASSIVE,
    Controller.OFF: BusState.BUS_OFF,
}


class BusWatch:
    """The state of one bus.

    An open interface does not prove that the bus works: it is present after the first received frame. `losses` also
    counts a loss that begins and ends between two readings of `state`.
    """

    def __init__(self, changed: Callable[[BusState, str], None] = lambda state, text: None) -> None:
        """Start in state GONE; `changed` is called with every new state and its text."""
        self.state = BusState.GONE
        self.text = "Not opened yet."
        self.losses = 0
        """Number of times that the bus became unusable."""
        self.lost_by = ""
        """Cause of the last loss."""
        self.error_counters: tuple[int, int] | None = None
        """Newest transmit and receive error counters of the controller."""
        self._changed = changed
        self._lock = threading.RLock()
        self._is_present = False
        self._controller = Controller.ACTIVE
        self._controller_text = ""
        self._controller_at = 0.0
        self._worry = ""
        self._worry_at = 0.0
        self._gone = self.text

    def opened(self, text: str) -> None:
        """Report that the interface was opened; the bus stays GONE with `text` until a frame arrives."""
        with self._lock:
            self.error_counters = None
            self.lost(text)

    def lost(self, text: str) -> None:
        """Report that the interface failed, was closed, or received no frame for too long."""
        with self._lock:
            self._is_present = False
            self._controller, self._worry = Controller.ACTIVE, ""
            self._gone = text
            self._settle()

    def heard(self, now: float) -> None:
        """Report a frame of another node at `now` [s]; not necessary in state OK."""
        with self._lock:
            self._is_present = True
            if self._controller is Controller.OFF or now - self._controller_at > RECOVERY:
                self._controller = Controller.ACTIVE  # a controller that is off the bus hears nothing
            if now - self._worry_at > WORRY:
                self._worry = ""
            self._settle()

    def error(self, frame: ErrorFrame, now: float) -> None:
        """Report an error frame at `now` [s]."""
        with self._lock:
            if frame.counters is not None:
                self.error_counters = frame.counters
            if frame.controller is not None:
                self._controller, self._controller_text, self._controller_at = frame.controller, frame.text, now
            if frame.text and self._controller is Controller.ACTIVE:
                self._worry, self._worry_at = frame.text, now
            self._settle()

    def worry(self, text: str, now: float) -> None:
        """Report a problem at `now` [s] that does not stop the bus."""
        with self._lock:
            self._worry, self._worry_at = text, now
            self._settle()

    def _settle(self) -> None:
        before = self.state
        if not self._is_present and self._controller is not Controller.OFF:
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
"""A receive thread with a turn longer than this [s] was frozen; it waits 0.4 of this time for a frame."""
HANGS = 1.0
"""A receive thread hangs if it has no turn for this time [s] and for `HUNG_CYCLES` cycles."""
HUNG_CYCLES = 3
"""A receive thread only hangs if more cycles than this ran without its turn: the process may have been frozen."""


class ThreadWatch:
    """Monitor of the receive thread, on the machine's own clock, because threads do not run in simulated time."""

    def __init__(self) -> None:
        self._turned = time.monotonic()
        self._seen = 0.0
        self._cycles = 0

    def start(self) -> None:
        """Start the time of the first turn."""
        self._turned = time.monotonic()

    def turn(self) -> bool:
        """Note a turn of the thread, and return whether the thread was frozen before it."""
        before, self._turned = self._turned, time.monotonic()
        return self._turned - before > FROZEN

    @property
    def is_turning(self) -> bool:
        """Whether the last turn is recent."""
        return time.monotonic() - self._turned < HANGS

    def hangs(self) -> bool:
        """Return whether the thread has no turn although the cycle continues; call once per cycle."""
        self._cycles = 0 if self._turned != self._seen else self._cycles + 1
        self._seen = self._turned
        return self._cycles > HUNG_CYCLES and not self.is_turning
