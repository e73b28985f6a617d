"""Sending frames on a bus without a queue.

A set-point that the interface does not take in its cycle is dropped, and that of the next cycle replaces it. So no old
command is sent late, however long the bus was gone. Single requests (NMT, SDO) have more time outside of the cycle, and
their senders repeat them without an answer.
"""

import errno
import threading
import time
from collections.abc import Callable

import can

from hal.protocols.can_frames import FD_SIZES, LONGEST, FrameLengths

PAUSE = 0.0002
"""A full interface is tried again after this time [s]; a frame at 1 Mbit/s needs about 0.1 ms."""
PAUSES = 10
"""All frames of a cycle together may wait for this number of pauses: 2 ms."""
TURN = 0.02
"""All frames of a cycle together may wait this long [s] for another thread that sends a frame. That is one system call,
but on a busy machine with one CPU a thread may be interrupted in it."""
PATIENCE = 0.05
"""A single request outside of the cycle may wait this long [s]."""
FAILED_SENDS = 3
"""The interface is opened again after this number of failures of one identifier in sequence."""
STUCK = 1.0
"""An interface that does not return from sending for this time [s] is blocked; a busy machine needs less."""
BETWEEN_LOOKS = 0.2
"""Of the time between two looks at most this much counts [s]: a machine that stands still stops both threads."""

_FULL = (None, errno.ENOBUFS, errno.EAGAIN)
_BUSY = can.CanOperationError("the interface is still busy with another frame", errno.EBUSY)


class Sender:
    """Sender for all threads; never raises, and never blocks the cycle longer than its pauses."""

    def __init__(self, counters: dict[str, int], failed: Callable[[str], None], lengths: FrameLengths) -> None:
        """Prepare.

        Args:
            counters: It has `sent` and `send_failures`, updated in place.
            failed: This is called with the reason of a failure.
            lengths: Lengths of the frames of the bus.
        """
        self.bits = 0.0
        """Sum of the longest lengths of all sent frames [bit at the bit rate of the bus]."""
        self._lengths = lengths
        self.is_barred = False
        """Whether the controller is off the bus, so that no frame is sent."""
        self._counters = counters
        self._failed = failed
        self._interface: can.BusABC | None = None
        self._lock = threading.Lock()
        self._pauses = PAUSES
        self._turn = TURN
        self._failures: dict[int, int] = {}
        self._failure = ""
        self._since: float | None = None
        self._watched, self._looked, self._waited = 0.0, 0.0, 0.0

    def use(self, interface: can.BusABC | None) -> None:
        """Send through a new interface, or through none, and forget earlier failures."""
        self._interface = interface
        self._failures.clear()
        self._failure = ""
        self._since = None

    def begin(self) -> None:
        """Begin a cycle, which has all its pauses again."""
        self._pauses, self._turn = PAUSES, TURN

    def problem(self) -> str:
        """Return the reason to open the interface again, empty without one; for one thread, which looks regularly."""
        since = self._since
        if since is not None:
            now = time.monotonic()
            if since != self._watched:
                self._watched, self._waited = since, 0.0
            else:
                self._waited += min(now - self._looked, BETWEEN_LOOKS)
            self._looked = now
            if self._waited > STUCK:
                return f"The interface has not returned from sending a frame for {STUCK:g} s."
        return self._failure

    def send(self, message: can.Message, patience: float = 0.0) -> bool:
        """Send a frame, and return whether the interface took it.

        Args:
            message: The frame.
            patience: Longest wait [s] for space in the interface, outside of the cycle; 0 in the cycle.
        """
        if self._interface is None or self.is_barred or self._failure:
            self._counters["send_failures"] += 1
            return False
        if not self._fits(message):
            return False
        error = self._try(message, patience)
        pauses = round(patience / PAUSE)
        while error is not None and _is_full(error):
            if pauses:
                pauses -= 1
            elif self._pauses and not patience:
                self._pauses -= 1
            else:
                break
            time.sleep(PAUSE)
            error = self._try(message, patience)
        if error is not None:
            self._note(message, error)
            return False
        if self._failures:
            self._failures.pop(message.arbitration_id, None)
        self._counters["sent"] += 1
        self.bits += self._lengths.of(len(message.data), message.is_extended_id, message.is_fd)
        return True

    def _fits(self, message: can.Message) -> bool:
        """Return whether the bus has such frames; if not, it is counted, and the reason is passed on."""
        size = len(message.data)
        if self._lengths.fits(size, message.is_fd):
            return True
        self._counters["send_failures"] += 1
        text = f"Frame {message.arbitration_id:03X}h has {size} data bytes; "
        if not message.is_fd:
            text += f"a classic frame has at most {LONGEST}."
        elif self._lengths.is_fd:
            text += f"one of CAN FD has {', '.join(map(str, FD_SIZES))}."
        else:
            text += "it is one of CAN FD, and the bus has no data_bitrate."
        self._failed(text)
        return False

    def _try(self, message: can.Message, patience: float) -> Exception | None:
        """Pass a frame to the interface as soon as no other thread uses it, and return an error."""
        if not self._lock.acquire(blocking=False) and not self._wait(patience):
            return _BUSY
        try:
            interface = self._interface
            if interface is None:
                return can.CanOperationError("the interface is closed", errno.ENODEV)
            self._since = time.monotonic()
            interface.send(message, 0)
        except Exception as error:  # an interface plugin may raise anything, and the cycle must go on
            return error
        finally:
            self._since = None
            self._lock.release()
        return None

    def _wait(self, patience: float) -> bool:
        """Wait for the interface while another thread uses it, and return whether this thread has it now."""
        if patience:
            return self._lock.acquire(timeout=patience)
        start = time.monotonic()
        is_ours = self._lock.acquire(timeout=self._turn)
        self._turn = max(self._turn - (time.monotonic() - start), 0.0)
        return is_ours

    def _note(self, message: can.Message, error: Exception) -> None:
        identifier = message.arbitration_id
        self._counters["send_failures"] += 1
        if error is _BUSY:  # `problem` reports an interface that stays busy
            return
        failures = self._failures[identifier] = self._failures.get(identifier, 0) + 1
        text = f"Frame {identifier:03X}h could not be sent: {error}."
        if failures >= FAILED_SENDS:
            self._failure = text
        self._failed(text)


def _is_full(error: Exception) -> bool:
    """Whether an interface has no space now, but works."""
    if isinstance(error, can.CanOperationError):
        return error.error_code in _FULL
    return isinstance(error, BlockingIOError)
