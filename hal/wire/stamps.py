"""Time of arrival of a frame on the monotonic clock, which all ages and deadlines use."""

import math

from hal.clock import BusClock

STAMPED = {"socketcan": "kernel", "udp_multicast": "kernel", "hub": "sender"}
"""The frames of these interfaces are stamped with the wall clock of this machine, by the kernel or by the sender. For
all others the time of reading counts."""
PLAUSIBLE = 0.005
"""A frame that seems older than this [s] waited, or the wall clock was set: the offset is measured again."""
STEP = 0.001
"""The wall clock was set if it moved by more than this [s] and `SLEW` between two measurements."""
SLEW = 0.001
"""The wall clock may be slewed at this rate [s/s]; Linux uses at most half of it."""
EARLY = 0.0002
"""Clocks that are not read at the same instant may differ by this time [s]."""
DOUBT = 0.1
"""Frames with stamps of the old wall clock may arrive for this time [s] after it was set."""
MEASURE_EVERY = 0.1
"""The offset between the clocks is measured with this period [s]."""
MEASURE_AGAIN = 0.002
"""A doubtful stamp causes a new measurement after this time [s] at the earliest, as reading a clock may be slow."""
_READ_WITHIN = 5e-5
_READ_BADLY = 5e-4
_READS = 4


WAITED = 0.0005
"""An interface that needs this time [s] to return a frame had no frame waiting."""


class ArrivalClock:
    """Clock for interfaces without usable stamps: the arrival of a frame is the time of reading.

    Frames that are read after this process was frozen get the earliest possible time of arrival.
    """

    def __init__(self) -> None:
        self.counters = {"waited": 0}
        """Number of frames that waited in the interface while this process was frozen."""
        self.since: float | None = None
        """Monotonic time [s] since which the frames that are read now may have waited; None if they did not wait."""

    def received(self, stamp: float, now: float) -> float:
        """Return `now`, or `since` for a frame that waited."""
        if self.since is None:
            return now
        self.counters["waited"] += 1
        return self.since


class FrameClock:
    """Clock that converts wall-clock stamps to monotonic times.

    A frame that waited while this process was frozen gets its true age. Setting the wall clock makes no frame newer or
    older: the offsets before and after are both tried. A stamp that fits neither is ignored.
    """

    def __init__(self, clock: BusClock) -> None:
        self.counters = {"waited": 0, "clock_steps": 0, "bad_stamps": 0}
        """Number of frames that waited for long, of steps of the wall clock, and of stamps in the future."""
        self._clock = clock
        self._offset = self._before = self._measure(None)
        self._set_at = -DOUBT
        self._measure_at = clock.monotonic() + MEASURE_EVERY

    def received(self, stamp: float, now: float) -> float:
        """Return the monotonic time of arrival of a frame [s], never after `now`.

        Args:
            stamp: Wall-clock stamp of the frame [s since 1970].
            now: Monotonic time at which it was read [s].
        """
        if now >= self._measure_at:
            self._update(now)
        received = stamp - self._offset
        if now - PLAUSIBLE < received <= now:
            return received
        return self._doubtful(stamp, now)

    def _doubtful(self, stamp: float, now: float) -> float:
        if now - (self._measure_at - MEASURE_EVERY) >= MEASURE_AGAIN:
            self._update(now)
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

    def _update(self, now: float) -> None:
        """Measure the offset, and detect a step of the wall clock."""
        passed = now - self._measure_at + MEASURE_EVERY
        self._measure_at = now + MEASURE_EVERY
        offset = self._measure(self._offset)
        if abs(offset - self._offset) > STEP + SLEW * passed:
            self.counters["clock_steps"] += 1
            self._before, self._set_at = self._offset, now
        self._offset = offset

    def _measure(self, otherwise: float | None) -> float:
        """Return wall-clock minus monotonic time [s], from the fastest of a few readings.

        Args:
            otherwise: Result if this thread is interrupted in all readings; None for the fastest reading.
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
