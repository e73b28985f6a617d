"""When a frame was received, on the monotonic clock that every age and deadline goes by."""

import math

from hal.clock import BusClock

STAMPED = {"socketcan": "kernel", "udp_multicast": "kernel", "hub": "sender"}
"""Interfaces whose frames bear wall-clock time of this machine, and whose clock that is; all others bear some time or
other, and what counts is when the frame was read."""
PLAUSIBLE = 0.005
"""A frame that seems to have waited longer [s] has, or the wall clock was set: it is looked at again."""
STEP = 0.001
"""A wall clock that moved by more than this [s] between two looks was set,"""
SLEW = 0.001
"""beside what it may be slewed [s/s]; Linux does at most half of that."""
EARLY = 0.0002
"""What clocks that are not read at the same instant may differ [s]."""
DOUBT = 0.1
"""For so long [s] after the wall clock was set, frames stamped before may still be read."""
LOOK_EVERY = 0.1
"""How often [s] the offset between the clocks is measured,"""
LOOK_AGAIN = 0.002
"""and how soon at the earliest when a stamp is doubted: where reading a clock is slow, not for every frame."""
_READ_WITHIN = 5e-5
_READ_BADLY = 5e-4
_READS = 4


WAITED = 0.0005
"""An interface that takes so long [s] to hand over a frame had none waiting."""


class ArrivalClock:
    """For stamps that are worth nothing: a frame came when it was read.

    Frames that were read after this process was frozen may have come at any time since; they are told as old as they
    can be.
    """

    def __init__(self) -> None:
        self.counters = {"waited": 0}
        """Frames that lay in the interface while this process was frozen."""
        self.since: float | None = None
        """Frames that are read now may have come since then [monotonic s]; None: they come as they are read."""

    def received(self, stamp: float, now: float) -> float:
        """See `FrameClock.received`."""
        if self.since is None:
            return now
        self.counters["waited"] += 1
        return self.since


class FrameClock:
    """Turns wall-clock stamps into monotonic times.

    A frame that waited while this process was frozen is told as old as it is. A wall clock that is set makes no frame
    newer or older: the offset before and the one after are both tried. A stamp that fits neither is not believed.
    """

    def __init__(self, clock: BusClock) -> None:
        self.counters = {"waited": 0, "clock_steps": 0, "bad_stamps": 0}
        """Frames that lay in the interface for long, times that the wall clock was set, stamps in the future."""
        self._clock = clock
        self._offset = self._before = self._measure(None)
        self._set_at = -DOUBT
        self._look_at = clock.monotonic() + LOOK_EVERY

    def received(self, stamp: float, now: float) -> float:
        """Monotonic time [s] at which a frame came, never after `now`.

        Args:
            stamp: Wall-clock time that the frame bears [s since 1970].
            now: Monotonic time at which it was read [s].
        """
        if now >= self._look_at:
            self._look(now)
        received = stamp - self._offset
        if now - PLAUSIBLE < received <= now:
            return received
        return self._doubtful(stamp, now)

    def _doubtful(self, stamp: float, now: float) -> float:
        if now - (self._look_at - LOOK_EVERY) >= LOOK_AGAIN:
            self._look(now)
        received = stamp - self._offset
        if now - self._set_at < DOUBT:
            other = stamp - self._before
            if received > now + EARLY or received < other <= now + EARLY:
                received = other
        if received > now + EARLY:
            self.counters["bad_stamps"] += 1
            return now
        if received < now - PLAUSIBLE:
            self.counters["waited"] += 1
        return min(received, now)

    def _look(self, now: float) -> None:
        """Measure the offset; notice when the wall clock was set."""
        passed = now - self._look_at + LOOK_EVERY
        self._look_at = now + LOOK_EVERY
        found = self._measure(self._offset)
        if abs(found - self._offset) > STEP + SLEW * passed:
            self.counters["clock_steps"] += 1
            self._before, self._set_at = self._offset, now
        self._offset = found

    def _measure(self, otherwise: float | None) -> float:
        """Wall-clock minus monotonic time [s], by the quickest of a few readings.

        Args:
            otherwise: What to answer if this thread is interrupted in all of them; None: the best of them all the same.
        """
        clock = self._clock
        offset, best = 0.0, math.inf
        for _ in range(_READS):
            before = clock.monotonic()
            wall = clock.now_ns()
            took = clock.monotonic() - before
            if took < best:
                offset, best = wall * 1e-9 - before - 0.5 * took, took
            if took < _READ_WITHIN:
                break
        return offset if otherwise is None or best < _READ_BADLY else otherwise
