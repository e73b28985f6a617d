"""Putting frames on a bus: at once or not at all.

The HAL keeps no queue. A set-point that the interface does not take in its cycle is dropped, and the one of the next
cycle replaces it, so that no old command goes out late, however long the bus was away. What is asked once (NMT, SDO) is
given longer, outside of the cycle, and asked again by whoever misses the answer.
"""

import errno
import threading
import time
from collections.abc import Callable

import can

from hal.wire.budget import frame_bits

PAUSE = 0.0002
"""Between two tries to have a full interface take a frame [s]; a frame at 1 Mbit/s needs about 0.1 ms."""
PAUSES = 10
"""All frames of a cycle together may wait for so many pauses: 2 ms, whatever the interface does."""
TURN = 0.02
"""All frames of a cycle together may wait so long [s] while another thread hands over a frame; that is one system call,
but on a busy machine with one CPU a thread may be interrupted in it."""
PATIENCE = 0.05
"""What is asked once may wait so long [s], and not in the cycle."""
FAILED_SENDS = 3
"""So many frames of one identifier in a row, and the interface is opened again."""
STUCK = 1.0
"""An interface that keeps a frame for so long [s] has hung; less, and the machine may have been busy."""

_BITS = tuple(frame_bits(size) for size in range(9))
_FULL = (None, errno.ENOBUFS, errno.EAGAIN)
_BUSY = can.CanOperationError("the interface is still busy with another frame", errno.EBUSY)


class Sender:
    """Sends for all threads; never raises, never blocks the cycle beyond its pauses."""

    def __init__(self, counters: dict[str, int], failed: Callable[[str], None]) -> None:
        """Prepare; `counters` has `sent` and `send_failures`, `failed` is told why a frame could not be sent."""
        self.bits = 0
        """Longest length of all frames that were sent [bit]."""
        self.is_barred = False
        """Nothing is sent while the controller is off the bus."""
        self._counters = counters
        self._failed = failed
        self._interface: can.BusABC | None = None
        self._lock = threading.Lock()
        self._pauses = PAUSES
        self._turn = TURN
        self._in_a_row: dict[int, int] = {}
        self._given_up = ""
        self._since: float | None = None

    def use(self, interface: can.BusABC | None) -> None:
        """Send through a fresh interface from now on, or through none; what failed before is forgotten."""
        self._interface = interface
        self._in_a_row.clear()
        self._given_up = ""
        self._since = None

    def begin(self) -> None:
        """A cycle begins, and may wait again."""
        self._pauses, self._turn = PAUSES, TURN

    @property
    def problem(self) -> str:
        """Why the interface must be opened again; empty if it need not."""
        since = self._since
        if since is not None and time.monotonic() - since > STUCK:
            return f"The interface has not come back from sending a frame for {STUCK:g} s."
        return self._given_up

    def send(self, message: can.Message, patience: float = 0.0) -> bool:
        """Put a frame on the bus; whether the interface took it.

        Args:
            message: The frame.
            patience: How long [s] it may wait for room beside the cycle's own pauses; 0 in the cycle.
        """
        if self._interface is None or self.is_barred or self._given_up:
            self._counters["send_failures"] += 1
            return False
        size = len(message.data)
        if size > 8:
            self._counters["send_failures"] += 1
            self._failed(f"Frame {message.arbitration_id:03X}h has {size} data bytes; a classic frame has at most 8.")
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
        if self._in_a_row:
            self._in_a_row.pop(message.arbitration_id, None)
        self._counters["sent"] += 1
        self.bits += _BITS[size]
        return True

    def _try(self, message: can.Message, patience: float) -> Exception | None:
        """What came of handing a frame to the interface, after waiting for another thread that does so."""
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
        """Wait for the interface while another thread uses it; whether it is ours now."""
        if patience:
            return self._lock.acquire(timeout=patience)
        start = time.monotonic()
        is_ours = self._lock.acquire(timeout=self._turn)
        self._turn = max(self._turn - (time.monotonic() - start), 0.0)
        return is_ours

    def _note(self, message: can.Message, error: Exception) -> None:
        identifier = message.arbitration_id
        self._counters["send_failures"] += 1
        if error is _BUSY:  # one that does not come back is a problem of its own, and told as such
            return
        failed = self._in_a_row[identifier] = self._in_a_row.get(identifier, 0) + 1
        text = f"Frame {identifier:03X}h could not be sent: {error}."
        if failed >= FAILED_SENDS:
            self._given_up = text
        self._failed(text)


def _is_full(error: Exception) -> bool:
    """Whether an interface has no room just now, rather than being broken."""
    if isinstance(error, can.CanOperationError):
        return error.error_code in _FULL
    return isinstance(error, BlockingIOError)
