"""Subscribers by identifier, and the rate of each identifier."""

from collections.abc import Callable

from hal.errors import ConfigError

Handler = Callable[[bytearray, float], None]
"""A handler is called in the receive thread with a frame's data and its monotonic time of arrival [s], and must not
block."""

EXTENDED = 1 << 31
"""This bit marks a 29-bit identifier."""
BABBLE = 4000.0
"""An identifier may have this number of frames per second [1/s], and more are not handled. No cycle needs as many; a
full bus of 1 Mbit/s carries twice as many."""
WINDOW = 0.05
"""The rate is measured over this time [s]."""
STRANGERS = 256
"""At most this number of identifiers without a subscriber is counted separately."""
FORGOTTEN = 10
"""A stranger is forgotten after this number of statistics periods without a frame."""
LISTENED = ((0x000, 0x7FF), (0x080, 0x780), (0x700, 0x780))
"""These identifiers and masks pass the filters without a subscriber: NMT of another master, SYNC and emergencies,
heartbeats and boot-ups of nodes that are not in the robot file."""

_WINDOW_FRAMES = round(BABBLE * WINDOW)


class FrameRoute:
    """Handler and frame count of one identifier."""

    __slots__ = ("counted", "handler", "limit", "quiet", "seen")

    def __init__(self, handler: Handler | None) -> None:
        self.handler = handler
        self.seen = 0
        self.limit = _WINDOW_FRAMES
        self.counted = 0
        self.quiet = 0


class Routes:
    """Map from identifier to route, for subscribed identifiers and for strangers (identifiers without subscriber)."""

    def __init__(self, bus: str) -> None:
        self.of: dict[int, FrameRoute] = {}
        """Routes by identifier; a 29-bit identifier has the bit `EXTENDED`."""
        self.window_end = 0.0
        self._bus = bus
        self._strangers = 0

    def add(self, identifier: int, handler: Handler, extended: bool) -> None:
        """Set the handler of an identifier.

        Raises:
            ConfigError: The identifier has a handler, or is out of range.
        """
        last = 0x1FFFFFFF if extended else 0x7FF
        if not 0 <= identifier <= last:
            raise ConfigError(f"There is no identifier {identifier:X}h on bus '{self._bus}'; the last is {last:X}h.")
        key = identifier | EXTENDED if extended else identifier
        present = self.of.get(key)
        if present is not None and present.handler is not None:
            raise ConfigError(f"Two devices on bus '{self._bus}' use the identifier {identifier:03X}h.")
        self._strangers -= present is not None
        self.of[key] = FrameRoute(handler)

    def stranger(self, key: int) -> FrameRoute | None:
        """Add an identifier without a subscriber and return its route; None if there are too many."""
        if self._strangers >= STRANGERS:
            return None
        self._strangers += 1
        self.of[key] = route = FrameRoute(None)
        return route

    def open_window(self, now: float) -> None:
        """Begin a new window at `now` [s], in which every identifier may again have `BABBLE * WINDOW` frames."""
        self.window_end = now + WINDOW
        for route in list(self.of.values()):
            route.limit = route.seen + _WINDOW_FRAMES

    def babblers(self, passed: float) -> list[tuple[str, float]]:
        """Return the identifiers above the allowed rate and their rates [1/s], over the `passed` time [s] since last.

        Strangers without frames for long are forgotten.
        """
        babblers = []
        for key, route in list(self.of.items()):
            rate = (route.seen - route.counted) / passed
            route.counted = route.seen
            if rate > BABBLE:
                babblers.append((name_of(key), rate))
            if route.handler is None:
                route.quiet = 0 if rate else route.quiet + 1
                if route.quiet >= FORGOTTEN:
                    del self.of[key]
                    self._strangers -= 1
        return babblers

    def strangers(self) -> list[int]:
        """Return received identifiers without a subscriber; a 29-bit identifier has the bit `EXTENDED`."""
        return sorted(key for key, route in list(self.of.items()) if route.handler is None)

    def filters(self) -> list[dict[str, int | bool]]:
        """Return python-can filters that pass subscribed identifiers and `LISTENED`."""
        filters: list[dict[str, int | bool]] = [
            {"can_id": identifier, "can_mask": mask, "extended": False} for identifier, mask in LISTENED
        ]
        for key, route in list(self.of.items()):
            if route.handler is None:
                continue
            extended = bool(key & EXTENDED)
            identifier = key & ~EXTENDED
            if extended or not any(identifier & mask == listened_id for listened_id, mask in LISTENED):
                mask = 0x1FFFFFFF if extended else 0x7FF
                filters.append({"can_id": identifier, "can_mask": mask, "extended": extended})
        return filters


def name_of(key: int) -> str:
    """Return an identifier in words, as `identifier 181h`."""
    return f"identifier {key & ~EXTENDED:0{8 if key & EXTENDED else 3}X}h"
