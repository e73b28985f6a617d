"""One CAN bus: a receive thread that lives on, whatever happens to the interface.

python-can's Notifier is not used: its thread ends at the first exception. canopen's network is fed from here and only
commissions; the cycle is `begin`, `send`, `sync`, the handlers and `wait`.
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
from hal.protocols import cia301
from hal.wire.budget import OWN_HEARTBEAT_RATE
from hal.wire.kernel import Kernel, set_buffers
from hal.wire.receive import OWN_NODE, Receiver
from hal.wire.routes import Handler
from hal.wire.send import PATIENCE, Sender
from hal.wire.stamps import STAMPED, WAITED, ArrivalClock, FrameClock
from hal.wire.state import UNUSABLE, BusState, BusWatch, ThreadWatch

__all__ = ["OWN_NODE", "PATIENCE", "Answers", "Bus", "BusState", "Handler"]

log = logging.getLogger(__name__)

OWN_HEARTBEAT_PERIOD = 1.0 / OWN_HEARTBEAT_RATE
"""[s]; the drives stop when it fails for their consumer heartbeat time."""
SILENCE = 1.0
"""No frame for so long [s] means that the interface may be another one by now: it is opened again."""
BACK_OFF = (0.05, 0.5)
"""First and longest pause [s] between tries to open; the first again once a frame was heard."""
RECEIVE_TIMEOUT = 0.1
MISSES_FORGIVEN = 4
"""A node that missed so many cycles in a row is not waited for any more, until it is heard."""
_FRAMES = ("received", "sent", "send_failures", "unknown", "ignored", "babbled", "broken_handlers", "error_frames")
COUNTERS = (*_FRAMES, "opened", "failures")
TOLD_STRANGERS = 8
ECHOING = ("udp_multicast",)
"""Interfaces that return to us what we send."""


class Answers(Protocol):
    """A device that answers once in every cycle, or sends by itself."""

    missed: int
    """Cycles in a row without its answer."""
    patience: int
    """Cycles within which it answers. It is waited for if that is 1; more for a device that goes by its own clock."""
    is_commissioned: bool


class _Network:
    """What canopen takes for a python-can bus: it can send, and never raises."""

    def __init__(self, sender: Sender) -> None:
        self._sender = sender

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self._sender.send(message, PATIENCE)


class Bus:
    """A CAN bus that is always there, though at times nobody answers."""

    def __init__(self, name: str, config: BusConfig, clock: BusClock) -> None:
        """Prepare; `open` opens.

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
        """Whether there are CANopen nodes, which wait for the SYNC and for the HAL's heartbeat."""
        self._config = config
        self._clock = clock
        self._watch = BusWatch(self._changed)
        self._losses = 0
        self._sender = Sender(self.counters, lambda text: self._watch.worry(text, clock.monotonic()))
        self.network = canopen.Network(_Network(self._sender))  # type: ignore[arg-type]
        self._arrival = ArrivalClock()
        self._frame_clock = FrameClock(clock) if config.interface in STAMPED else self._arrival
        self._receiver = Receiver(name, config.bitrate, self._watch, self.counters, self._frame_clock)
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
        """What the bus can do for us."""
        return self._watch.state

    @property
    def text(self) -> str:
        """One sentence a person can act on; empty when all is well."""
        return self._watch.text

    @property
    def is_receiving(self) -> bool:
        """Whether the receive thread is alive and came back from the interface lately, frames or none."""
        thread = self._thread
        return thread is not None and thread.is_alive() and self._thread_watch.is_turning

    def subscribe(self, identifier: int, handler: Handler, extended: bool = False) -> None:
        """Have `handler` called with every data frame of an identifier; one handler each.

        Raises:
            ConfigError: It is taken, or out of range.
        """
        self._receiver.routes.add(identifier, handler, extended)
        interface = self._can
        if interface is not None:
            self._kernel.filter(interface, self._receiver.routes)

    def subscriber(self, identifier: int) -> Handler | None:
        """Who is called with the frames of an identifier, so that drives which answer under one can share it."""
        route = self._receiver.routes.of.get(identifier)
        return route.handler if route else None

    def expect(self, node: Answers) -> None:
        """Wait in every cycle for `answered(node)`."""
        self._nodes.append(node)

    def answered(self, node: Answers) -> None:
        """A device's answer of this cycle has come; called in the receive thread."""
        waiting = self._waiting
        waiting.discard(node)
        if not waiting:
            self._answered.set()

    def open(self) -> None:
        """Start receiving; returns when the interface was tried once, also if that failed."""
        self._closing.clear()
        self._tried.clear()
        self._thread_watch.start()
        self._thread = threading.Thread(target=self._run, name=f"bus {self.name}", daemon=True)
        self._thread.start()
        self._tried.wait(5.0)

    def close(self) -> None:
        """Stop receiving and let go of the interface. Safe to call twice."""
        self._closing.set()
        if self._thread:
            self._thread.join()
            self._thread = None

    def send(self, message: can.Message, patience: float = 0.0) -> bool:
        """Put a frame on the bus; whether the interface took it. Never raises.

        Args:
            message: The frame. If it is not taken it is dropped: the next cycle has a newer one.
            patience: How long [s] it may wait for room; 0 in the cycle, whose frames may together wait for 2 ms.
        """
        return self._sender.send(message, patience)

    def begin(self) -> None:
        """Begin a cycle, before anything is sent: some devices answer their set-point, others the SYNC."""
        self._sender.begin()
        self._waiting = {n for n in self._nodes if n.patience == 1 and n.is_commissioned and n.missed < MISSES_FORGIVEN}
        self._answered.clear()
        if self._thread_watch.hangs() and self.state is not BusState.GONE:
            self._watch.lost("Its receive thread hangs. Is the adapter still plugged in?")

    def sync(self, now: float) -> None:
        """Send the SYNC, and now and then the HAL's own heartbeat, if anybody waits for them."""
        if not self.needs_sync:
            return
        self._sender.send(self._sync)
        if now - self._beat >= OWN_HEARTBEAT_PERIOD:
            self._beat = now
            self._sender.send(self._heartbeat)

    def wait(self, deadline: float) -> bool:
        """Wait until every device has answered, or the deadline [monotonic s]; whether every node has."""
        waiting = self._waiting
        while waiting and self._clock.wait(self._answered, deadline):
            self._answered.clear()
        complete = not waiting
        for node in self._nodes:
            # The receive thread sets it to 0 at an answer, so that it never looks fresher than it is.
            node.missed += 1
            complete &= node.missed <= node.patience
        return complete

    def trouble(self) -> str:
        """What made the bus unusable now, or at some time since this was asked last; empty if nothing did."""
        watch = self._watch
        losses, self._losses = self._losses, watch.losses
        return watch.lost_by if watch.state in UNUSABLE or watch.losses != losses else ""

    def health(self) -> dict[str, Any]:
        """State, a sentence, share of the bit rate that is used, counters, and whose clock stamps the frames."""
        return {
            "state": self.state.value,
            "text": self.text,
            "load": round(self._receiver.load, 4),
            "is_receiving": self.is_receiving,
            "stamps": STAMPED.get(self._config.interface, "arrival"),
            "error_counters": self._watch.error_counters,
            "unknown": self._receiver.strangers()[:TOLD_STRANGERS],
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
            except BaseException as error:  # an interface plugin may raise anything, and this thread must live on
                self.counters["failures"] += 1
                self._watch.lost(f"{type(error).__name__}: {error} Trying again.")
                log.debug("bus %s", self.name, exc_info=True)
            self._let_go()
            self._tried.set()
            pause = BACK_OFF[0] if self.counters["received"] > received else min(2 * pause, BACK_OFF[1])
            self._closing.wait(pause)
        self._watch.lost("Closed.")

    def _new_interface(self) -> can.BusABC:
        config = self._config
        self._can = interface = can.Bus(
            config.channel, config.interface, ignore_config=True, bitrate=config.bitrate, **config.options
        )
        set_buffers(interface)
        self._kernel = Kernel(config.interface, config.channel)
        self._kernel.filter(interface, self._receiver.routes)
        self._watch.opened("Open, but nothing was heard yet. Is a node powered, is the bus terminated?")
        self._sender.use(interface)
        self.counters["opened"] += 1
        return interface

    def _let_go(self) -> None:
        self._sender.use(None)
        interface, self._can = self._can, None
        if interface is not None:
            try:
                interface.shutdown()
            except Exception:  # a dead adapter may refuse even to close
                log.debug("bus %s does not close", self.name, exc_info=True)

    def _receive(self, interface: can.BusABC) -> None:
        """Handle frames until the bus is closed, silent, or not able to send."""
        receiver, sender, monotonic = self._receiver, self._sender, self._clock.monotonic
        opened = now = monotonic()
        while not self._closing.is_set():
            message = self._next(interface, now)
            now = monotonic()
            if message is not None:
                receiver.handle(message, now)
            if now >= receiver.stock_due:
                receiver.has_master = self.needs_sync and self._config.interface not in ECHOING
                receiver.take_stock(now, sender.bits, self._kernel.received())
            if sender.problem:
                raise ConnectionError(sender.problem)
            if message is not None:
                continue
            silent = now - max(receiver.heard, opened)
            if silent > SILENCE:
                raise ConnectionError(f"Nothing was heard for {silent:.1f} s. Is a node powered?")
            self._closing.wait(0.001)  # some interfaces return at once when their peer is dead

    def _next(self, interface: can.BusABC, before: float) -> can.Message | None:
        """The next frame, or None after a while; `before` is when the last one was read [s]."""
        arrival = self._arrival
        asked = 0.0 if arrival.since is None else time.monotonic()
        message = interface.recv(RECEIVE_TIMEOUT)
        if self._thread_watch.turn():
            arrival.since = before
        elif asked and (message is None or time.monotonic() - asked > WAITED):
            arrival.since = None
        return message

    def _changed(self, state: BusState, text: str) -> None:
        self._sender.is_barred = state is BusState.BUS_OFF
        is_expected = state is BusState.OK or self._closing.is_set()
        log.log(logging.INFO if is_expected else logging.WARNING, "bus %s is %s. %s", self.name, state, text)
