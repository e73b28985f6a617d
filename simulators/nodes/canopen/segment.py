"""One CAN bus with all the simulated nodes on it, behind a single python-can bus object."""

import contextlib
import logging
import threading
from collections.abc import Callable, Sequence

import can

from simulators.hub import HubBus, message_identifier
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.kinds import make
from simulators.nodes.node import EXTENDED, Frame, Handler
from simulators.nodes.plant import Plant
from simulators.wire_time import ERROR, FD

_log = logging.getLogger(__name__)

SYNC = 0x080
TICK = 0.005
"""Nodes are advanced at this interval [s]."""
MOST_ANSWERING = 0.02
"""Frames are answered first for at most this long [s] after nodes are due to advance."""
_REOPEN = 0.2
"""A failed bus is opened again after this pause [s]."""


class Segment:
    """The nodes of one bus; frames that they send in one go leave in one go."""

    def __init__(self, name: str, specs: Sequence[NodeSpec], plant: Plant, open_bus: Callable[[], can.BusABC]) -> None:
        """Make the nodes; nothing is on the bus yet.

        Args:
            name: Of the bus, in the robot file.
            specs: The nodes on it.
            plant: What they measure.
            open_bus: Joins the bus; called again after the bus failed.
        """
        self.name = name
        self.lock = threading.Lock()
        """Lock of every thread that uses the nodes."""
        self._outbox: list[Frame] = []
        self.nodes = {spec.name: make(spec, plant, self._outbox) for spec in specs}
        self._listeners = list(self.nodes.values())
        self._open_bus = open_bus
        self._bus: can.BusABC | None = None
        self._routes: dict[int, list[Handler]] = {}
        self._is_routed = False
        self.counters = {"received": 0, "sent": 0, "lost": 0, "reopened": 0}
        for node in self._listeners:
            node.routes_changed = self._forget_routes

    def open(self, now: float) -> None:
        """Join the bus and switch the nodes on."""
        self._bus = self._open_bus()
        with self.lock:
            for node in self._listeners:
                node.power_up(now)
            self._flush()

    def close(self) -> None:
        """Leave the bus. Safe to call twice."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    def answer(self, now: float) -> None:
        """Take every frame that waits, and answer."""
        with self.lock:
            while frames := self._receive(0.0):
                self._handle(frames, now)
            self._flush()

    def tick(self, now: float) -> None:
        """Let time pass for every node."""
        with self.lock:
            for node in self._listeners:
                node.tick(now)
            self._flush()

    def serve(self, monotonic: Callable[[], float], is_running: Callable[[], bool]) -> None:
        """Answer and tick in real time, and open a failed bus again, until stopped."""
        due = monotonic()
        while is_running():
            try:
                frames = self._receive(max(due - monotonic(), 0.0))
                if frames:
                    self._answer_from(frames, monotonic, due + MOST_ANSWERING)
                if monotonic() >= due:  # heartbeats that waited have been heard by now
                    self.tick(monotonic())
                    due = max(due + TICK, monotonic())
            except (can.CanError, OSError) as error:
                self._reopen(error, is_running)

    def _answer_from(self, frames: list[Frame], monotonic: Callable[[], float], until: float) -> None:
        """Answer these frames and those that wait for a limited time, so that a busy node still sends its heartbeat."""
        with self.lock:
            while frames:
                now = monotonic()
                self._handle(frames, now)
                frames = self._receive(0.0) if now < until else []
            self._flush()

    def _receive(self, timeout: float) -> list[Frame]:
        """Return frames that came, with the flags in their identifiers; none after `timeout` [s]."""
        assert self._bus is not None, "the segment is not open"
        if isinstance(self._bus, HubBus):
            return self._bus.receive_frames(timeout)
        message = self._bus.recv(timeout)
        return [] if message is None else [(message_identifier(message), bytes(message.data))]

    def _handle(self, frames: list[Frame], now: float) -> None:
        for identifier, data in frames:
            if identifier & ERROR:
                continue
            self.counters["received"] += 1
            if identifier == SYNC:
                for node in self._listeners:
                    node.sync(now)
                self._flush()
                continue
            if not self._is_routed:
                self._route()
            for handler in self._routes.get(identifier, ()):
                handler(data, now)

    def _forget_routes(self) -> None:
        self._is_routed = False

    def _route(self) -> None:
        self._routes = {}
        for node in self._listeners:
            for identifier, handler in node.routes().items():
                self._routes.setdefault(identifier, []).append(handler)
        self._is_routed = True

    def _flush(self) -> None:
        if not self._outbox:
            return
        frames = self._outbox.copy()
        self._outbox.clear()
        if isinstance(self._bus, HubBus):
            self._bus.send_frames(frames)
        elif self._bus is not None:
            for identifier, data in frames:
                self._send(self._bus, _message(identifier, data))
        self.counters["sent"] += len(frames)

    def _send(self, bus: can.BusABC, message: can.Message) -> None:
        try:
            bus.send(message, timeout=0.01)
        except can.CanOperationError:  # a full transmit queue loses a frame, as it would in a device
            self.counters["lost"] += 1

    def _reopen(self, error: Exception, is_running: Callable[[], bool]) -> None:
        _log.warning("bus %s: %s Opening it again.", self.name, error)
        pause = threading.Event()
        while is_running():
            with contextlib.suppress(can.CanError, OSError):
                self.close()
                self._bus = self._open_bus()
                self.counters["reopened"] += 1
                return
            pause.wait(_REOPEN)


def _message(identifier: int, data: bytes) -> can.Message:
    """Return the message of a frame of a node, whose identifier has flags."""
    is_fd = bool(identifier & FD)
    return can.Message(
        arbitration_id=identifier & ~(EXTENDED | FD),
        is_extended_id=bool(identifier & EXTENDED),
        is_fd=is_fd,
        bitrate_switch=is_fd,
        data=data,
    )
