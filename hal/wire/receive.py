"""What becomes of a frame that was received: counted, timed, handed to whoever wants it."""

import logging
import math

import can

from hal.protocols import cia301
from hal.protocols.error_frames import error_frame
from hal.wire.budget import frame_bits
from hal.wire.routes import EXTENDED, Routes, name_of
from hal.wire.stamps import ArrivalClock, FrameClock
from hal.wire.state import BusState, BusWatch

log = logging.getLogger(__name__)

OWN_NODE = 127
"""Node id under which the HAL sends its own heartbeat."""
STOCK_PERIOD = 1.0
"""How often [s] load and strangers are looked at."""
HIGH_LOAD = 0.8
"""Share of the bit rate above which frames wait long for one another."""

_BITS = tuple(frame_bits(size) for size in range(9))
_BITS_EXTENDED = tuple(frame_bits(size, is_extended=True) for size in range(9))
_OURS = (cia301.SYNC, cia301.HEARTBEAT + OWN_NODE)
_NODES = range(cia301.HEARTBEAT + 1, cia301.HEARTBEAT + OWN_NODE)


class Receiver:
    """Handles the frames of one bus, all in its receive thread."""

    def __init__(
        self, name: str, bitrate: int, watch: BusWatch, counters: dict[str, int], frame_clock: FrameClock | ArrivalClock
    ) -> None:
        """Prepare.

        Args:
            name: Of the bus.
            bitrate: Of the bus [bit/s].
            watch: Is told what is seen.
            counters: Counted in place.
            frame_clock: What to make of the stamps of frames.
        """
        self.routes = Routes(name)
        self.heard = -math.inf
        """When the last frame of another node was read [monotonic s]."""
        self.load = 0.0
        """Share of the bit rate that frames took when stock was taken last, both ways and stuffed at worst."""
        self.has_master = False
        """Whether we are the ones who send the SYNC, and nobody else should."""
        self.stock_due = -math.inf
        self._name = name
        self._bitrate = bitrate
        self._watch = watch
        self._counters = counters
        self._frame_clock = frame_clock
        self._bits = 0
        self._stock: tuple[float, int, int | None] = (0.0, 0, None)
        self._logged = -math.inf

    def handle(self, message: can.Message, now: float) -> None:
        """Take in one frame, read at monotonic time `now` [s]. Never raises."""
        if message.is_error_frame:
            self._on_error_frame(message, now)
            return
        self.heard = now
        counters = self._counters
        counters["received"] += 1
        data = message.data
        size = len(data)
        if message.is_remote_frame or message.is_fd or size > 8:
            counters["ignored"] += 1
            return
        identifier = message.arbitration_id
        if message.is_extended_id:
            identifier |= EXTENDED
            self._bits += _BITS_EXTENDED[size]
        else:
            self._bits += _BITS[size]
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
            except BaseException as error:  # whatever a frame does to its handler, the next frame must be handled
                self._on_broken_handler(identifier, error, now)

    def take_stock(self, now: float, sent_bits: int, passed_kernel: int | None = None) -> None:
        """Work out the load, and complain of what should not be on the bus.

        Args:
            now: Monotonic time [s].
            sent_bits: Longest length of all frames that we ever sent [bit].
            passed_kernel: Frames that the kernel ever received, those included that it kept away; None: not known.
        """
        self.stock_due = now + STOCK_PERIOD
        since, before, unseen_before = self._stock
        unseen = None if passed_kernel is None else passed_kernel - self._counters["received"]
        bits = self._bits + sent_bits
        self._stock = (now, bits, unseen)
        passed = now - since
        if not 0 < passed < 10 * STOCK_PERIOD:
            return
        kept_away = 0 if unseen is None or unseen_before is None else max(unseen - unseen_before, 0)
        self.load = (bits - before + kept_away * _BITS[8]) / (passed * self._bitrate)
        complaint = ""
        if self.load > HIGH_LOAD:
            complaint = f"The bus is loaded to {self.load:.0%}. Is a node sending more than it was told to?"
        for key in self.routes.strangers() if self.has_master else ():
            if key in _OURS:
                complaint = f"Somebody else sends our {name_of(key)}. Is another master or another HAL on this bus?"
        for name, rate in self.routes.babblers(passed):
            complaint = f"{name.capitalize()} babbles: {rate:.0f} frames/s. What is beyond the limit is not handled."
        if complaint:
            self._watch.worry(complaint, now)

    def strangers(self) -> list[str]:
        """Who is on the bus and not wanted, in words."""
        return [
            f"node {key - cia301.HEARTBEAT}" if key in _NODES and self.has_master else name_of(key)
            for key in self.routes.strangers()
        ]

    def _on_error_frame(self, message: can.Message, now: float) -> None:
        self._counters["error_frames"] += 1
        self._watch.error(error_frame(message.arbitration_id, message.data), now)

    def _on_broken_handler(self, identifier: int, error: BaseException, now: float) -> None:
        self._counters["broken_handlers"] += 1
        told = f"{name_of(identifier)} on bus {self._name}: {type(error).__name__}: {error}"
        self._watch.worry(f"The handler of {told}. Please report it.", now)
        if now - self._logged > STOCK_PERIOD:
            self._logged = now
            log.error("handler of %s", told, exc_info=error)
