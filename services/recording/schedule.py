"""Schedule of a replay: recorded times divided by the speed, a pause with single steps, and jumps to other times."""

import threading
import time
from dataclasses import dataclass

LATE = 0.005
"""A message that is published more than this [s] after its time counts as late."""
LONGEST_PAUSE = 10.0
"""A pause in the recordings that is longer than this [s] is cut to one second."""
SHOWN = 0.3
"""A jump in a pause publishes the last messages of this time [s] before the place: one of each kind at least."""
LOOK_EVERY = 0.1
"""The end of the replay is noticed within this time [s]."""


@dataclass(slots=True)
class ReplayCounts:
    """Counts of a replay so far.

    Attributes:
        messages: Published messages.
        samples: Published samples of the HAL.
        reached: Played time of the recordings [s].
        position: Time of the newest message since the beginning of the recordings [s].
        late: Messages published more than `LATE` after their time.
        latest: Largest lateness [s].
        pauses: Pauses that were cut to one second.
    """

    messages: int = 0
    samples: int = 0
    reached: float = 0.0
    position: float = 0.0
    late: int = 0
    latest: float = 0.0
    pauses: int = 0


class Schedule:
    """Times of the messages, on an absolute grid while playing, on request while paused.

    Args:
        speed: Multiple of the recorded speed; 0 begins paused, and plays at the recorded speed later.
        begin_ns: Beginning of the recordings [ns].
        stop: Event that ends the replay.
        counts: Counts of the replay, which the schedule completes.
    """

    def __init__(self, speed: float, begin_ns: int, stop: threading.Event, counts: ReplayCounts) -> None:
        self.is_paused = speed == 0.0
        """Whether messages are published only on request."""
        self._speed, self._begin_ns, self._stop, self._counts = speed or 1.0, begin_ns, stop, counts
        self._changed = threading.Condition()
        self._allowed = 0
        self._wanted_ns: int | None = None
        self._until_ns = 0
        self._is_idle = False
        self._begun, self._begun_ns = time.monotonic(), time.time_ns()
        self._is_begun = not self.is_paused
        self._last_ns: int | None = None
        self._elapsed = 0.0

    def pause(self) -> None:
        """Publish nothing more until `play` or `allow`."""
        with self._changed:
            self.is_paused, self._is_begun, self._allowed = True, False, self._counts.samples
            self._changed.notify_all()

    def play(self) -> None:
        """Go on at the speed."""
        with self._changed:
            self.is_paused = False
            self._changed.notify_all()

    def allow(self, count: int, within: float) -> None:
        """Pause, release `count` more samples and wait until they are played, at most `within` [s]."""
        with self._changed:
            self.is_paused, self._is_begun, self._allowed = True, False, self._counts.samples + count
            self._is_idle = False
            self._changed.notify_all()
            self._changed.wait_for(self._is_waiting, within)

    def seek(self, received_ns: int, within: float) -> None:
        """Go on from another arrival [ns]; in a pause wait at most `within` [s] until that moment is published."""
        with self._changed:
            self._is_begun, self._is_idle, self._until_ns = False, False, received_ns
            self._allowed = self._counts.samples
            self._wanted_ns = received_ns - round(1e9 * SHOWN) if self.is_paused else received_ns
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._wanted_ns is None and self._is_waiting(), within)

    def taken(self) -> int | None:
        """Return the arrival [ns] to go on from if another one was wanted; None without."""
        with self._changed:
            wanted, self._wanted_ns = self._wanted_ns, None
            if wanted is not None:
                self._last_ns = None
            return wanted

    def wait(self, received_ns: int) -> bool:
        """Wait until the message with this arrival is due; return False if the replay ends or jumps."""
        with self._changed:
            self._advance(received_ns)
            while not self._stop.is_set() and self._wanted_ns is None:
                left = self._left(received_ns)
                self._is_idle = left > 0.0
                if left <= 0.0:
                    self._counts.position = (received_ns - self._begin_ns) * 1e-9
                    if not self.is_paused:
                        self._counts.late += -left > LATE
                        self._counts.latest = max(self._counts.latest, -left)
                    return True
                self._changed.notify_all()
                self._changed.wait(min(left, LOOK_EVERY))
            return False

    def stamp_ns(self, recorded_ns: int, received_ns: int) -> int:
        """Return the new stamp of a message [ns]: now in a pause; else its transit, divided by the speed, stays."""
        if self.is_paused:
            return time.time_ns()
        transit_ns = (received_ns - recorded_ns) / self._speed
        return self._begun_ns + round(1e9 * self._elapsed / self._speed - transit_ns)

    def end(self) -> None:
        """Wake all waiting threads; the replay has ended."""
        with self._changed:
            self._changed.notify_all()

    def _left(self, received_ns: int) -> float:
        """Return the time until the message with this arrival is due [s]; infinite in a pause."""
        if self.is_paused:
            is_wanted = self._counts.samples < self._allowed or received_ns <= self._until_ns
            return 0.0 if is_wanted else float("inf")
        played = self._elapsed / self._speed
        if not self._is_begun:
            self._is_begun = True
            self._begun, self._begun_ns = time.monotonic() - played, time.time_ns() - round(1e9 * played)
        return self._begun + played - time.monotonic()

    def _advance(self, received_ns: int) -> None:
        if self._last_ns is not None:
            step = max(received_ns - self._last_ns, 0) * 1e-9
            if step > LONGEST_PAUSE:
                self._counts.pauses += 1
                step = 1.0
            self._elapsed += step
        self._last_ns = received_ns
        self._counts.reached = self._elapsed

    def _is_waiting(self) -> bool:
        """Whether everything that was requested is published, or the replay plays or has ended."""
        is_done = self.is_paused and self._is_idle and self._counts.samples >= self._allowed
        return self._stop.is_set() or is_done or self._is_begun
