"""One CAN bus, with a receive thread that survives every failure of the interface.

The thread of python-can's Notifier ends at the first exception, so it is not used. The network of canopen gets its
frames from here and is only used for commissioning. A cycle is `begin`, `send`, `sync`, the handlers and `wait`.
"""

import logging
import math
import threading
import time
from typing import Any, Protocol

import can
import canopen

from hal.clock import BusClock
from hal.config import BusConfig
from hal.errors import ConfigError
from hal.log_limit import LogLimit
from hal.protocols import cia301
from hal.protocols.can_frames import FrameLengths
from hal.wire.budget import OWN_HEARTBEAT_RATE
from hal.wire.interface import open_interface
from hal.wire.kernel import Kernel, set_buffers
from hal.wire.receive import OWN_NODE, Receiver
from hal.wire.routes import Handler
from hal.wire.send import PATIENCE, Sender
from hal.wire.stamps import STAMPED, WAITED, ArrivalClock, FrameClock
from hal.wire.state import UNUSABLE, BusState, BusWatch, ThreadWatch

__all__ = ["OWN_NODE", "PATIENCE", "Answers", "Bus", "BusState", "Handler"]

log = logging.getLogger(__name__)

OWN_HEARTBEAT_PERIOD = 1.0 / OWN_HEARTBEAT_RATE
"""The HAL sends its heartbeat with this period [s]; drives stop after their consumer heartbeat time without one."""
SILENCE = 1.0
"""The interface is opened again after this time [s] without a frame, because it may have been replaced."""
BACK_OFF = (0.05, 0.5)
"""Attempts to open have these first and longest pauses [s]; the first again after a received frame."""
RECEIVE_TIMEOUT = 0.1
MISSES_FORGIVEN = 4
"""A cycle does not wait for a node that missed this number of cycles in sequence, until it answers again."""
_FRAMES = ("received", "sent", "send_failures", "unknown", "ignored", "babbled", "broken_handlers", "error_frames")
COUNTERS = (*_FRAMES, "opened", "failures")
MAX_STRANGERS = 8
ECHOING = ("udp_multicast",)
"""These interfaces return sent frames to the sender."""


class Answers(Protocol):
    """A device that answers once in every cycle, or sends by itself."""

    missed: int
    """Number of cycles since its last answer."""
    patience: int
    """Number of cycles within which it answers; the cycle waits if this is 1. More for a device with its own clock."""
    is_commissioned: bool


class _Network:
    """Replacement of a python-can bus for canopen; it sends and never raises."""

    def __init__(self, sender: Sender) -> None:
        self._sender = sender

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self._sender.send(message, PATIENCE)


class Bus:
    """A CAN bus that stays usable as an object while its interface fails and returns."""

    def __init__(self, name: str, config: BusConfig, clock: BusClock) -> None:
        """Prepare; nothing is opened yet.

        Raises:
            ConfigError: python-can does not know the interface.
        """
        if config.interface not in can.VALID_INTERFACES:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise ConfigError(
                f"buses.{name}.interface '{config.interface}' is not known to python-can. Known: {known}."
            )
        self.name = name
        self.counters = dict.fromkeys(COUNTERS, 0)
        self.needs_sync = False
        """Whether the bus has CANopen nodes, which need the SYNC and the HAL's heartbeat."""
        self._config = config
        self._clock = clock
        self._log = LogLimit(log)
        self._watch = BusWatch(self._changed)
        self._losses = 0
        lengths = FrameLengths(config.bitrate, config.data_bitrate)
        self._sender = Sender(self.counters, lambda text: self._watch.worry(text, clock.monotonic()), lengths)
        self.network = canopen.Network(_Network(self._sender))  # type: ignore[arg-type]
        self._arrival = ArrivalClock()
        self._frame_clock = FrameClock(clock) if config.interface in STAMPED else self._arrival
        self._receiver = Receiver(name, config.bitrate, self._watch, self.counters, self._frame_clock, lengths)
        self._handle = self._receiver.handle
        self._kernel = Kernel(config.interface, config.channel)
        self._can: can.BusABC | None = None
        self._nodes: list[Answers] = []
        self._waiting: set[Answers] = set()
        self._answered = threading.Event()
        self._tried = threading.Event()
        self._closing = threading.Event()
        self._beat = -math.inf
        self._thread_watch = ThreadWatch()
        self._thread: threading.Thread | None = None
        self._sync = can.Message(arbitration_id=cia301.SYNC, is_extended_id=False)
        self._heartbeat = can.Message(
            arbitration_id=cia301.HEARTBEAT + OWN_NODE, is_extended_id=False, data=[cia301.NmtState.OPERATIONAL]
        )

    @property
    def state(self) -> BusState:
        """State of the bus."""
        return self._watch.state

    @property
    def is_fd(self) -> bool:
        """Whether the bus carries frames of CAN FD too."""
        return self._config.is_fd

    @property
    def text(self) -> str:
        """Problem and remedy in one sentence for the operator; empty without a problem."""
        return self._watch.text

    @property
    def is_receiving(self) -> bool:
        """Whether the receive thread is alive and returned from the interface recently, with or without a frame."""
        thread = self._thread
        return thread is not None and thread.is_alive() and self._thread_watch.is_turning

    def subscribe(self, identifier: int, handler: Handler, extended: bool = False) -> None:
        """Call `handler` with every data frame of an identifier from now on; an identifier has one handler.

        Raises:
            ConfigError: The identifier has a handler, or is out of range.
        """
        self._receiver.routes.add(identifier, handler, extended)
        interface = self._can
        if interface is not None:
            self._kernel.filter(interface, self._receiver.routes)

    def subscriber(self, identifier: int) -> Handler | None:
        """Return the handler of an identifier, so that drives which answer under the same one can share it."""
        route = self._receiver.routes.of.get(identifier)
        return route.handler if route else None

    def expect(self, node: Answers) -> None:
        """Wait in every cycle for `answered(node)`."""
        self._nodes.append(node)

    def answered(self, node: Answers) -> None:
        """Note the answer of a device in this cycle; called in the receive thread."""
        waiting = self._waiting
        waiting.discard(node)
        if not waiting:
            self._answered.set()

    def open(self) -> None:
        """Start receiving, and return after the first attempt to open the interface, also if it failed."""
        self._closing.clear()
        self._tried.clear()
        self._thread_watch.start()
        self._thread = threading.Thread(target=self._run, name=f"bus {self.name}", daemon=True)
        self._thread.start()
        self._tried.wait(5.0)

    def close(self) -> None:
        """Stop receiving and close the interface. Safe to call twice."""
        self._closing.set()
        if self._thread:
            self._thread.join()
            self._thread = None

    def send(self, message: can.Message, patience: float = 0.0) -> bool:
        """Send a frame, and return whether the interface took it. Never raises.

        Args:
            message: The frame. It is dropped if the interface does not take it: the next cycle sends a newer one.
            patience: Longest wait [s] for space in the interface; 0 in the cycle, whose frames share 2 ms.
        """
        return self._sender.send(message, patience)

    def begin(self) -> None:
        """Begin a cycle, before the first frame: some devices answer their set-point, others the SYNC."""
        self._sender.begin()
        self._waiting = {n for n in self._nodes if n.patience == 1 and n.is_commissioned and n.missed < MISSES_FORGIVEN}
        self._answered.clear()
        if self._thread_watch.hangs() and self.state is not BusState.GONE:
            self._watch.lost("Its receive thread hangs. Is the adapter still plugged in?")

    def sync(self, now: float) -> None:
        """Send the SYNC, and the HAL's heartbeat when it is due, if the bus has CANopen nodes."""
        if not self.needs_sync:
            return
        self._sender.send(self._sync)
        if now - self._beat >= OWN_HEARTBEAT_PERIOD:
            self._beat = now
            self._sender.send(self._heartbeat)

    def wait(self, deadline: float) -> bool:
        """Wait for the answers of all devices until the deadline [monotonic s], and return whether all answered."""
        waiting = self._waiting
        while waiting and self._clock.wait(self._answered, deadline):
            self._answered.clear()
        complete = not waiting
        for node in self._nodes:
            # The receive thread sets `missed` to 0 at an answer, so that it never looks fresher than it is.
            node.missed += 1
            complete &= node.missed <= node.patience
        return complete

    def trouble(self) -> str:
        """Return the problem that made the bus unusable now or since the last call; empty without one."""
        watch = self._watch
        losses, self._losses = self._losses, watch.losses
        return watch.lost_by if watch.state in UNUSABLE or watch.losses != losses else ""

    def health(self) -> dict[str, Any]:
        """Return state, problem, load as a share of the bit rate, counters, and the clock that stamps frames."""
        return {
            "state": self.state.value,
            "text": self.text,
            "load": round(self._receiver.load, 4),
            "is_receiving": self.is_receiving,
            "stamps": STAMPED.get(self._config.interface, "arrival"),
            "error_counters": self._watch.error_counters,
            "unknown": self._receiver.strangers()[:MAX_STRANGERS],
            "counters": {**self.counters, **self._frame_clock.counters},
        }

    def _run(self) -> None:
        pause = BACK_OFF[0]
        while not self._closing.is_set():
            received = self.counters["received"]
            try:
                interface = self._new_interface()
                self._tried.set()
                self._receive(interface)
            except BaseException as error:  # an interface plugin may raise anything, and this thread must survive
                self.counters["failures"] += 1
                text = f"{type(error).__name__}: {error} Trying again."
                self._watch.lost(text)
                if self.counters["failures"] == 1 and not self.counters["opened"]:
                    self._changed(BusState.GONE, text)  # a bus begins in this state, so it is no change
                log.debug("bus %s", self.name, exc_info=True)
            self._close_interface()
            self._tried.set()
            pause = BACK_OFF[0] if self.counters["received"] > received else min(2 * pause, BACK_OFF[1])
            self._closing.wait(pause)
        self._watch.lost("Closed.")

    def _new_interface(self) -> can.BusABC:
        config = self._config
        self._can = interface = open_interface(config)
        set_buffers(interface)
        self._kernel = Kernel(config.interface, config.channel)
        self._kernel.filter(interface, self._receiver.routes)
        self._watch.opened("Open, but no frame was received yet. Is a node powered, is the bus terminated?")
        self._sender.use(interface)
        self.counters["opened"] += 1
        return interface

    def _close_interface(self) -> None:
        self._sender.use(None)
        interface, self._can = self._can, None
        if interface is not None:
            try:
                interface.shutdown()
            except Exception:  # closing a dead adapter may fail too
                log.debug("bus %s does not close", self.name, exc_info=True)

    def _receive(self, interface: can.BusABC) -> None:
        """Handle frames until the bus is closed, silent, or cannot send."""
        receiver, sender, monotonic = self._receiver, self._sender, self._clock.monotonic
        opened = now = monotonic()
        while not self._closing.is_set():
            message = self._next(interface, now)
            now = monotonic()
            if message is not None:
                receiver.handle(message, now)
            if now >= receiver.statistics_due:
                receiver.has_master = self.needs_sync and self._config.interface not in ECHOING
                receiver.update_statistics(now, sender.bits, self._kernel.received())
            if problem := sender.problem():
                raise ConnectionError(problem)
            if message is not None:
                continue
            silent = now - max(receiver.heard, opened)
            if silent > SILENCE:
                raise ConnectionError(f"No frame was received for {silent:.1f} s. Is a node powered?")
            self._closing.wait(0.001)  # some interfaces return at once if their peer is dead

    def _next(self, interface: can.BusABC, before: float) -> can.Message | None:
        """Return the next frame, or None after `RECEIVE_TIMEOUT`; `before` is the time of the last reading [s]."""
        arrival = self._arrival
        start = 0.0 if arrival.since is None else time.monotonic()
        message = interface.recv(RECEIVE_TIMEOUT)
        if self._thread_watch.turn():
            arrival.since = before
        elif start and (message is None or time.monotonic() - start > WAITED):
            arrival.since = None
        return message

    def _changed(self, state: BusState, text: str) -> None:
        self._sender.is_barred = state is BusState.BUS_OFF
        is_expected = state is BusState.OK or self._closing.is_set()
        level = logging.INFO if is_expected else logging.WARNING
        self._log.line(level, state, time.monotonic(), f"bus {self.name} is {state}. {text}")
