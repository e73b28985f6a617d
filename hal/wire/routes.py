"""Who wants which identifier, and how often it comes."""

from collections.abc import Callable

from hal.errors import ConfigError

Handler = Callable[[bytearray, float], None]
"""Called in the receive thread with a frame's data and its monotonic time of arrival [s]; must not block."""

EXTENDED = 1 << 31
"""Marks a 29-bit identifier among the 11-bit ones."""
BABBLE = 4000.0
"""Frames of one identifier per second [1/s] beyond which the rest is not handled: more than any cycle asks for, half
of what a full bus of 1 Mbit/s carries."""
WINDOW = 0.05
"""Over so long [s] the rate is taken."""
STRANGERS = 256
"""So many identifiers that nobody wants are told apart."""
FORGOTTEN = 10
"""A stranger that was not heard while stock was taken so many times is gone."""
LISTENED = ((0x000, 0x7FF), (0x080, 0x780), (0x700, 0x780))
"""Identifiers and masks that are let in though nobody wants them: NMT of another master, SYNC and emergencies,
heartbeats and boot-ups of nodes that the robot file does not name."""

_WINDOW_FRAMES = round(BABBLE * WINDOW)


class Route:
    """What happens with the frames of one identifier."""

    __slots__ = ("counted", "handler", "limit", "quiet", "seen")

    def __init__(self, handler: Handler | None) -> None:
        self.handler = handler
        self.seen = 0
        self.limit = _WINDOW_FRAMES
        self.counted = 0
        self.quiet = 0


class Routes:
    """Identifier -> route, for those that are wanted and for strangers."""

    def __init__(self, bus: str) -> None:
        self.of: dict[int, Route] = {}
        """By identifier, with `EXTENDED` added to 29-bit ones."""
        self.window_end = 0.0
        self._bus = bus
        self._strangers = 0

    def add(self, identifier: int, handler: Handler, extended: bool) -> None:
        """Have frames handled.

        Raises:
            ConfigError: They are already, or there is no such identifier.
        """
        last = 0x1FFFFFFF if extended else 0x7FF
        if not 0 <= identifier <= last:
            raise ConfigError(f"There is no identifier {identifier:X}h on bus '{self._bus}'; the last is {last:X}h.")
        key = identifier | EXTENDED if extended else identifier
        present = self.of.get(key)
        if present is not None and present.handler is not None:
            raise ConfigError(f"Two devices on bus '{self._bus}' use the identifier {identifier:03X}h.")
        self._strangers -= present is not None
        self.of[key] = Route(handler)

    def stranger(self, key: int) -> Route | None:
        """Note an identifier that nobody wants; None if there are too many."""
        if self._strangers >= STRANGERS:
            return None
        self._strangers += 1
        self.of[key] = route = Route(None)
        return route

    def open_window(self, now: float) -> None:
        """Let every identifier have its frames of the next window, which begins `now` [s]."""
        self.window_end = now + WINDOW
        for route in list(self.of.values()):
            route.limit = route.seen + _WINDOW_FRAMES

    def babblers(self, passed: float) -> list[tuple[str, float]]:
        """Identifiers over the allowed rate, and their rates [1/s], in the `passed` time [s] since asked last.

        Strangers that fell silent are forgotten.
        """
        found = []
        for key, route in list(self.of.items()):
            rate = (route.seen - route.counted) / passed
            route.counted = route.seen
            if rate > BABBLE:
                found.append((name_of(key), rate))
            if route.handler is None:
                route.quiet = 0 if rate else route.quiet + 1
                if route.quiet >= FORGOTTEN:
                    del self.of[key]
                    self._strangers -= 1
        return found

    def strangers(self) -> list[int]:
        """Identifiers, marked with `EXTENDED`, that were heard and that nobody wants."""
        return sorted(key for key, route in list(self.of.items()) if route.handler is None)

    def filters(self) -> list[dict[str, int | bool]]:
        """What python-can shall let in: what is wanted, and what tells of strangers."""
        listened: list[dict[str, int | bool]] = [
            {"can_id": identifier, "can_mask": mask, "extended": False} for identifier, mask in LISTENED
        ]
        for key, route in list(self.of.items()):
            if route.handler is None:
                continue
            extended = bool(key & EXTENDED)
            identifier = key & ~EXTENDED
            if extended or not any(identifier & mask == listened_id for listened_id, mask in LISTENED):
                mask = 0x1FFFFFFF if extended else 0x7FF
                listened.append({"can_id": identifier, "can_mask": mask, "extended": extended})
        return listened


def name_of(key: int) -> str:
    """An identifier in words, as `identifier 181h`."""
    return f"identifier {key & ~EXTENDED:0{8 if key & EXTENDED else 3}X}h"
