"""Answers of several drives under one identifier, sorted by the id inside."""

from hal.drivers.can_device import Place
from hal.errors import ConfigError
from hal.protocols import mit
from hal.protocols.mit import Layout
from hal.wire.bus import Bus, Handler


class Replies:
    """What listens to one identifier, under which each drive of one make says its id in the first byte."""

    def __init__(self, bus: Bus, layout: Layout) -> None:
        self.layout = layout
        self._bus = bus
        self._mask = 0x0F if layout is Layout.DAMIAO else 0xFF
        self._handlers: dict[int, Handler] = {}

    @classmethod
    def join(cls, place: Place, identifier: int, layout: Layout, handler: Handler) -> None:
        """Have `handler` called with the answers of the drive at `place` under `identifier`.

        Raises:
            ConfigError: It can have no such id, or the answers of two devices could not be told apart.
        """
        highest = 0xFF if layout is Layout.T_MOTOR else mit.NODES - 1
        if not 1 <= place.node <= highest:
            raise ConfigError(f"{place}: the id of such a drive is between 1 and {highest}.")
        bus = place.bus
        replies = bus.subscriber(identifier)
        if not isinstance(replies, cls) or replies.layout is not layout:
            replies = cls(bus, layout)
            bus.subscribe(identifier, replies)
        key = place.node & replies._mask
        if key in replies._handlers:
            raise ConfigError(
                f"Two drives on bus '{bus.name}' answer under {identifier:03X}h with the id {key:X}h, and cannot be "
                "told apart. Give one of them another `master_id` or node."
            )
        replies._handlers[key] = handler

    def __call__(self, data: bytearray, received: float) -> None:
        """Pass a frame on; one of a drive that the robot file does not have is counted as unknown."""
        handler = self._handlers.get(data[0] & self._mask) if data else None
        if handler is None:
            self._bus.counters["unknown"] += 1
        else:
            handler(data, received)
