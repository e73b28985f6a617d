"""A wire between the HAL and its nodes that loses, repeats, cuts, delays and forges frames, by settings and a seed.

It joins two python-can buses of any interface, one with the HAL and one with the nodes. It moves frames between them
only on request, so on interface `virtual` a test does not wait in real time and every run is the same.
"""

import random
from collections import deque
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field

import can

from hal.protocols.can_frames import LONGEST, LONGEST_FD, fd_size

BUS_OFF, RESTARTED, NO_ACKNOWLEDGE, CONTROLLER = 0x40, 0x100, 0x20, 0x04
"""These are classes of error frames, and below them details of `CONTROLLER` (linux/can/error.h)."""
WARNING, PASSIVE = 0x0C, 0x30
_NODE = 0x7F
_SHARED = (0x000, 0x080)
"""The identifiers of NMT and SYNC carry no node id."""


@dataclass(frozen=True, slots=True)
class Chances:
    """Probabilities, 0 to 1, of the faults of a frame.

    Attributes:
        loss: The frame does not arrive.
        duplicate: The frame arrives twice.
        short: Its last bytes are missing.
        long: Bytes are added, as far as the frame can have more.
        corrupt: One of its bytes is changed. Only frames of nodes, because a checksum protects frames on the wire.
        delay: The frame arrives `delayed_by` later, after frames that were sent after it.
        delayed_by: Delay [s].
    """

    loss: float = 0.0
    duplicate: float = 0.0
    short: float = 0.0
    long: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    delayed_by: float = 0.0


@dataclass(slots=True)
class _Direction:
    """Source, target and delayed frames of one direction."""

    name: str
    source: can.BusABC
    target: can.BusABC
    late: deque[tuple[float, can.Message]] = field(default_factory=deque)


class FaultyWire:
    """Wire between the HAL and the nodes of one bus; without settings it only passes frames on.

    Each direction and identifier has its own stream of random numbers, so a request at another time does not change
    the faults of the other frames.
    """

    def __init__(self, hal: can.BusABC, nodes: can.BusABC, seed: int = 0) -> None:
        """Join two buses.

        Args:
            hal: Bus on the channel that the HAL opens, for this wire only.
            nodes: Bus on the channel that the nodes open, for this wire only.
            seed: Seed of all random numbers.
        """
        self._hal, self._nodes = hal, nodes
        self._to_nodes = _Direction("to nodes", hal, nodes)
        self._to_hal = _Direction("to hal", nodes, hal)
        self._seed = seed
        self._streams: dict[tuple[str, int], random.Random] = {}
        self.chances = Chances()
        self.is_cut = False
        """Whether the wire is cut: no frame arrives, without an error."""
        self.lost: frozenset[int] = frozenset()
        """Identifiers whose frames do not arrive."""
        self.readdressed: Mapping[int, int] = {}
        """Node id -> wrong id that the node uses on the bus; two nodes may have the same id."""
        self.babble: Callable[[random.Random], list[tuple[int, bytes]]] | None = None
        """Frames that an additional node sends each time `to_hal` is called."""
        self.forged: dict[int, Callable[[bytes, float], bytes]] = {}
        """Identifier -> (data, time [s]) -> data that the HAL receives instead: a node that lies."""
        self.counters = {"passed": 0, "lost": 0, "changed": 0}

    def to_nodes(self, now: float) -> None:
        """Pass on the frames that the HAL has sent until time `now` [s]."""
        self._move(self._to_nodes, now)

    def to_hal(self, now: float) -> None:
        """Pass on the frames that the nodes have sent until time `now` [s]."""
        self._move(self._to_hal, now)
        if self.babble is not None and not self.is_cut:
            for identifier, data in self.babble(self._stream("babble", 0)):
                self.say(identifier, data)

    def say(self, identifier: int, data: bytes) -> None:
        """Send a forged data frame to the HAL."""
        self.pass_on(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def pass_on(self, message: can.Message) -> None:
        """Send a forged frame of any kind to the HAL."""
        _put(self._hal, message)

    def error(self, kind: int, detail: int = 0) -> None:
        """Send an error frame to the HAL, as a CAN controller reports its own state."""
        data = bytes([0, detail, *bytes(6)])
        self._hal.send(can.Message(arbitration_id=kind, is_error_frame=True, data=data))

    def close(self) -> None:
        """Leave both buses."""
        self._hal.shutdown()
        self._nodes.shutdown()

    def _move(self, direction: _Direction, now: float) -> None:
        fresh = []
        while (message := direction.source.recv(0)) is not None:
            fresh.append(message)
        while direction.late and direction.late[0][0] <= now:
            self._deliver(direction, direction.late.popleft()[1])
        for message in fresh:
            for readdressed in self._addressed(direction, message):
                self._pass(direction, readdressed, now)

    def _addressed(self, direction: _Direction, message: can.Message) -> list[can.Message]:
        """Return the frame as readdressed nodes receive it: once, twice, or not at all."""
        node = message.arbitration_id & _NODE
        if not self.readdressed or message.is_error_frame or message.arbitration_id in _SHARED:
            return [message]
        if direction is self._to_hal:
            return [_with_node(message, self.readdressed.get(node, node))]
        listeners = [own for own, shown in self.readdressed.items() if shown == node]
        if node not in self.readdressed:
            listeners.append(node)
        return [_with_node(message, listener) for listener in listeners]

    def _pass(self, direction: _Direction, message: can.Message, now: float) -> None:
        chances, draw = self.chances, self._stream(direction.name, message.arbitration_id)
        if self.is_cut or message.arbitration_id in self.lost or draw.random() < chances.loss:
            self.counters["lost"] += 1
            return
        if direction is self._to_hal and message.arbitration_id in self.forged:
            message = _with_data(message, self.forged[message.arbitration_id](bytes(message.data), now))
        message = self._changed(message, draw, direction is self._to_hal)
        if draw.random() < chances.duplicate:
            self._deliver(direction, message)
        if draw.random() < chances.delay:
            direction.late.append((now + chances.delayed_by, message))
        else:
            self._deliver(direction, message)

    def _changed(self, message: can.Message, draw: random.Random, is_from_node: bool) -> can.Message:
        data, chances = bytes(message.data), self.chances
        if draw.random() < chances.short:
            data = data[: draw.randrange(max(len(data), 1))]
        largest = LONGEST_FD if message.is_fd else LONGEST
        if draw.random() < chances.long and len(data) < largest:
            data += draw.randbytes(draw.randint(1, largest - len(data)))
        if is_from_node and draw.random() < chances.corrupt and data:
            place = draw.randrange(len(data))
            data = data[:place] + bytes([data[place] ^ draw.randint(1, 255)]) + data[place + 1 :]
        if data == message.data:
            return message
        self.counters["changed"] += 1
        return _with_data(message, data)

    def _deliver(self, direction: _Direction, message: can.Message) -> None:
        self.counters["passed"] += 1
        _put(direction.target, message)

    def _stream(self, name: str, identifier: int) -> random.Random:
        key = (name, identifier)
        if key not in self._streams:
            self._streams[key] = random.Random(f"{self._seed} {name} {identifier}")
        return self._streams[key]


def _with_node(message: can.Message, node: int) -> can.Message:
    readdressed = copy(message)
    readdressed.arbitration_id = message.arbitration_id & ~_NODE | node
    return readdressed


def _with_data(message: can.Message, data: bytes) -> can.Message:
    return can.Message(
        arbitration_id=message.arbitration_id,
        data=data.ljust(fd_size(len(data)), b"\0") if message.is_fd else data,
        is_extended_id=message.is_extended_id,
        is_fd=message.is_fd,
        bitrate_switch=message.bitrate_switch,
    )


def _put(bus: can.BusABC, message: can.Message) -> None:
    bus.send(message, timeout=1.0)
