"""Handling of received frames: count, time of arrival, call of the subscriber, statistics."""

import logging
import math

import can

from hal.protocols import cia301
from hal.protocols.can_frames import LONGEST, FrameLengths
from hal.protocols.error_frames import error_frame
from hal.wire.routes import EXTENDED, Routes, name_of
from hal.wire.stamps import ArrivalClock, FrameClock
from hal.wire.state import BusState, BusWatch

log = logging.getLogger(__name__)

OWN_NODE = 127
"""The HAL sends its own heartbeat under this node id."""
STATISTICS_PERIOD = 1.0
"""Load and strangers are evaluated with this period [s]."""
HIGH_LOAD = 0.8
"""Above this share of the bit rate frames wait long for each other."""

_OURS = (cia301.SYNC, cia301.HEARTBEAT + OWN_NODE)
_NODES = range(cia301.HEARTBEAT + 1, cia301.HEARTBEAT + OWN_NODE)


class Receiver:
    """Receiver of the frames of one bus; runs in its receive thread."""

    def __init__(
        self,
        name: str,
        bitrate: int,
        watch: BusWatch,
        counters: dict[str, int],
        frame_clock: FrameClock | ArrivalClock,
        lengths: FrameLengths,
    ) -> None:
        """Prepare.

        Args:
            name: Name of the bus.
            bitrate: Bit rate of the bus [bit/s].
            watch: State of the bus, updated here.
            counters: Counters, updated in place.
            frame_clock: Clock that converts the stamps of frames.
            lengths: Lengths of the frames of the bus.
        """
        self.routes = Routes(name)
        self.heard = -math.inf
        """Monotonic time at which the last frame of another node was read [s]."""
        self.load = 0.0
        """Share of the bit rate in the last statistics period, in both directions, with the most stuff bits."""
        self.has_master = False
        """Whether the HAL sends the SYNC, so that no other node may."""
        self.statistics_due = -math.inf
        self._name = name
        self._bitrate = bitrate
        self._watch = watch
        self._counters = counters
        self._frame_clock = frame_clock
        self._lengths = lengths
        self._bits = 0.0
        self._last: tuple[float, float, int | None] = (0.0, 0.0, None)
        self._logged = -math.inf

    def handle(self, message: can.Message, now: float) -> None:
        """Handle one frame that was read at monotonic time `now` [s]. Never raises."""
        if message.is_error_frame:
            self._on_error_frame(message, now)
            return
        self.heard = now
        counters = self._counters
        counters["received"] += 1
        data = message.data
        size = len(data)
        lengths = self._lengths
        if message.is_remote_frame or not lengths.fits(size, message.is_fd):
            counters["ignored"] += 1
            return
        identifier = message.arbitration_id
        if message.is_extended_id:
            identifier |= EXTENDED
        self._bits += lengths.of(size, message.is_extended_id, message.is_fd)
        if self._watch.state is not BusState.OK:
            self._watch.heard(now)
        received = self._frame_clock.received(message.timestamp, now)
        routes = self.routes
        if received >= routes.window_end:
            routes.open_window(received)
        route = routes.of.get(identifier) or routes.stranger(identifier)
        if route is None:
            counters["unknown"] += 1
            return
        route.seen = seen = route.seen + 1
        if seen > route.limit:
            counters["babbled"] += 1
        elif route.handler is None:
            counters["unknown"] += 1
        else:
            try:
                route.handler(data, received)
            except BaseException as error:  # after any error of a handler the next frame must be handled
                self._on_broken_handler(identifier, error, now)

    def update_statistics(self, now: float, sent_bits: float, kernel_count: int | None = None) -> None:
        """Compute the load, and warn of frames that should not be on the bus.

        Args:
            now: Monotonic time [s].
            sent_bits: Longest length of all frames that the HAL ever sent [bit at the bit rate of the bus].
            kernel_count: Frames that the kernel ever received, including filtered ones; None if unknown.
        """
        self.statistics_due = now + STATISTICS_PERIOD
        since, bits_before, unseen_before = self._last
        unseen = None if kernel_count is None else kernel_count - self._counters["received"]
        bits = self._bits + sent_bits
        self._last = (now, bits, unseen)
        passed = now - since
        if not 0 < passed < 10 * STATISTICS_PERIOD:
            return
        filtered = 0 if unseen is None or unseen_before is None else max(unseen - unseen_before, 0)
        self.load = (bits - bits_before + filtered * self._lengths.classic[LONGEST]) / (passed * self._bitrate)
        warning = ""
        if self.load > HIGH_LOAD:
            warning = f"The bus is loaded to {self.load:.0%}. Does a node send more than configured?"
        for key in self.routes.strangers() if self.has_master else ():
            if key in _OURS:
                warning = f"Another node sends our {name_of(key)}. Is another master or another HAL on this bus?"
        for name, rate in self.routes.babblers(passed):
            warning = f"{name.capitalize()} babbles: {rate:.0f} frames/s. Frames above the limit are not handled."
        if warning:
            self._watch.worry(warning, now)

    def strangers(self) -> list[str]:
        """Return in words the received nodes and identifiers that have no subscriber."""
        return [
            f"node {key - cia301.HEARTBEAT}" if key in _NODES and self.has_master else name_of(key)
            for key in self.routes.strangers()
        ]

    def _on_error_frame(self, message: can.Message, now: float) -> None:
        self._counters["error_frames"] += 1
        self._watch.error(error_frame(message.arbitration_id, message.data), now)

    def _on_broken_handler(self, identifier: int, error: BaseException, now: float) -> None:
        self._counters["broken_handlers"] += 1
        text = f"{name_of(identifier)} on bus {self._name}: {type(error).__name__}: {error}"
        self._watch.worry(f"Error in the handler of {text}. Please report it.", now)
        if now - self._logged > STATISTICS_PERIOD:
            self._logged = now
            log.error("handler of %s", text, exc_info=error)
