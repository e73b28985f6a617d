"""One receive thread per CAN bus, its state machine and its reopening.

python-can's Notifier is not used: its thread ends at the first exception. canopen's network is fed from here and only
commissions; the cycle is `sync`, the handlers and `wait`.
"""

import logging
import math
import threading
from collections.abc import Callable
from enum import StrEnum
from typing import Any, Protocol

import can
import canopen

from hal.budget import OWN_HEARTBEAT_RATE, frame_bits
from hal.clock import Clock
from hal.config import BusConfig
from hal.errors import ConfigError
from hal.protocols import cia301

log = logging.getLogger(__name__)

Handler = Callable[[bytearray, float], None]
"""Called in the receive thread with a frame's data and its monotonic time of arrival [s]; must not block."""

OWN_NODE = 127
"""Node id under which the HAL sends its own heartbeat."""
OWN_HEARTBEAT_PERIOD = 1.0 / OWN_HEARTBEAT_RATE
"""[s]; the drives stop when it fails for their consumer heartbeat time."""
SILENCE = 1.0
"""No frame for so long [s] means that the interface may be another one by now: it is opened again."""
BACK_OFF = (0.05, 0.5)
"""First and longest pause [s] between tries to open."""
RECEIVE_TIMEOUT = 0.1
SEND_TIMEOUT = 0.002
"""The cycle cannot wait longer [s] for room in the send buffer."""
FAILED_SENDS = 3
"""So many in a row, and the interface is opened again."""
ERROR_MEMORY = 1.0
"""A warning without another error frame is over after [s]."""
MISSES_FORGIVEN = 4
"""A node that missed so many cycles in a row is not waited for any more, until it is heard."""

_BITS = tuple(frame_bits(size) for size in range(9))


class BusClock(Clock, Protocol):
    """A clock by which one can also wait for an answer."""

    def wait(self, event: threading.Event, deadline: float) -> bool:
        """Sleep until the event is set, at most until the deadline [s]; whether it was set."""
        ...


class BusState(StrEnum):
    """What a bus can do for us, worst last."""

    OK = "ok"
    WARNING = "warning"
    PASSIVE = "passive"
    BUS_OFF = "bus-off"
    GONE = "gone"
    """Not open, or nothing was heard since it was opened."""


class Answers(Protocol):
    """A device that answers once in every cycle."""

    missed: int
    """Cycles in a row without its answer."""
    is_commissioned: bool


class _Sender:
    """What canopen takes for a python-can bus: it can send, and never raises."""

    def __init__(self, send: Callable[[can.Message], bool]) -> None:
        self._send = send

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self._send(message)


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
        self.state = BusState.GONE
        self.text = "Not opened yet."
        self.counters = dict.fromkeys(
            ("received", "sent", "opened", "unknown", "ignored", "error_frames", "broken_handlers", "send_failures"), 0
        )
        self.needs_sync = False
        """Whether there are CANopen nodes, which wait for the SYNC and for the HAL's heartbeat."""
        self.network = canopen.Network(_Sender(self.send))  # type: ignore[arg-type]
        self._config = config
        self._clock = clock
        self._can: can.BusABC | None = None
        self._handlers: dict[int, Handler] = {}
        self._nodes: list[Answers] = []
        self._waiting: set[Answers] = set()
        self._answered = threading.Event()
        self._tried = threading.Event()
        self._closing = threading.Event()
        self._send_lock = threading.Lock()
        self._failed_sends = 0
        self._opened = self._heard = self._last_error = self._beat = -math.inf
        self._bits = 0
        self._load_since = (0.0, 0)
        self._thread: threading.Thread | None = None
        self._sync = can.Message(arbitration_id=cia301.SYNC, is_extended_id=False)
        self._heartbeat = can.Message(
            arbitration_id=cia301.HEARTBEAT + OWN_NODE, is_extended_id=False, data=[cia301.NmtState.OPERATIONAL]
        )

    def subscribe(self, cob_id: int, handler: Handler) -> None:
        """Have `handler` called with every data frame of an identifier; one handler each."""
        if cob_id in self._handlers:
            raise ConfigError(f"Two devices on bus '{self.name}' use the identifier {cob_id:03X}h.")
        self._handlers[cob_id] = handler

    def subscriber(self, cob_id: int) -> Handler | None:
        """Who is called with the frames of an identifier, so that drives which answer under one can share it."""
        return self._handlers.get(cob_id)

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
        self._thread = threading.Thread(target=self._run, name=f"bus {self.name}", daemon=True)
        self._thread.start()
        self._tried.wait(5.0)

    def close(self) -> None:
        """Stop receiving and let go of the interface. Safe to call twice."""
        self._closing.set()
        if self._thread:
            self._thread.join()
            self._thread = None

    def send(self, message: can.Message) -> bool:
        """Put a frame on the bus, waiting at most `SEND_TIMEOUT`; whether the interface took it. Never raises."""
        with self._send_lock:
            interface = self._can
            if interface is None or self._failed_sends >= FAILED_SENDS:  # about to be opened again
                self.counters["send_failures"] += 1
                return False
            try:
                interface.send(message, SEND_TIMEOUT)
            except (can.CanError, OSError, ValueError) as error:
                self.counters["send_failures"] += 1
                self._failed_sends += 1
                self.text = f"A frame could not be sent: {error}."
                return False
            self._failed_sends = 0
            self.counters["sent"] += 1
            self._bits += _BITS[len(message.data)]
            return True

    def begin(self) -> None:
        """Begin a cycle, before anything is sent: some devices answer their set-point, others the SYNC."""
        self._waiting = {n for n in self._nodes if n.is_commissioned and n.missed < MISSES_FORGIVEN}
        self._answered.clear()

    def sync(self, now: float) -> None:
        """Send the SYNC, and now and then the HAL's own heartbeat, if anybody waits for them."""
        if not self.needs_sync:
            return
        self.send(self._sync)
        if now - self._beat >= OWN_HEARTBEAT_PERIOD:
            self._beat = now
            self.send(self._heartbeat)

    def wait(self, deadline: float) -> bool:
        """Wait until every device has answered, or the deadline [monotonic s]; whether every node has."""
        waiting = self._waiting
        while waiting and self._clock.wait(self._answered, deadline):
            self._answered.clear()
        complete = not waiting
        for node in self._nodes:
            # The receive thread sets it to 0 at an answer, so that it never looks fresher than it is.
            node.missed += 1
            complete &= node.missed == 1
        return complete

    def health(self) -> dict[str, Any]:
        """State, a sentence, the share of the bit rate used since the last call, and counters."""
        now, bits = self._clock.monotonic(), self._bits
        since, before = self._load_since
        self._load_since = (now, bits)
        load = (bits - before) / ((now - since) * self._config.bitrate) if now > since else 0.0
        return {"state": self.state.value, "text": self.text, "load": round(load, 4), "counters": dict(self.counters)}

    def _run(self) -> None:
        pause = BACK_OFF[0]
        while not self._closing.is_set():
            try:
                self._can = self._new_interface()
                self._tried.set()
                pause = BACK_OFF[0]
                self._receive(self._can)
            except Exception as error:  # an interface plugin may raise anything, and this thread must live on
                self._mark(BusState.GONE, f"{type(error).__name__}: {error} Trying again.")
                log.debug("bus %s", self.name, exc_info=True)
            self._let_go()
            self._tried.set()
            self._closing.wait(pause)
            pause = min(2 * pause, BACK_OFF[1])
        self.state, self.text = BusState.GONE, "Closed."

    def _new_interface(self) -> can.BusABC:
        config = self._config
        self._opened = self._clock.monotonic()
        interface = can.Bus(
            config.channel, config.interface, ignore_config=True, bitrate=config.bitrate, **config.options
        )
        self.counters["opened"] += 1
        self._failed_sends = 0
        self._opened = self._clock.monotonic()
        self._mark(BusState.GONE, "Open, but nothing was heard yet. Is a node powered, is the bus terminated?")
        return interface

    def _let_go(self) -> None:
        with self._send_lock:
            interface, self._can = self._can, None
        if interface is not None:
            try:
                interface.shutdown()
            except Exception:  # a dead adapter may refuse even to close
                log.debug("bus %s does not close", self.name, exc_info=True)

    def _receive(self, interface: can.BusABC) -> None:
        """Handle frames until the bus is closed, silent, or not able to send."""
        while not self._closing.is_set():
            message = interface.recv(RECEIVE_TIMEOUT)
            if self._failed_sends >= FAILED_SENDS:
                raise ConnectionError(self.text)
            now = self._clock.monotonic()
            if message is not None:
                self._handle(message, now)
                continue
            silent = now - max(self._heard, self._opened)
            if silent > SILENCE:
                raise ConnectionError(f"Nothing was heard for {silent:.1f} s. Is a node powered?")
            self._closing.wait(0.001)  # some interfaces return at once when their peer is dead

    def _handle(self, message: can.Message, now: float) -> None:
        if message.is_error_frame:
            self.counters["error_frames"] += 1
            self._last_error = now
            self._mark(*_error_state(message, self.state))
            return
        self._heard = now
        counters = self.counters
        counters["received"] += 1
        data = message.data
        if message.is_extended_id or message.is_remote_frame or message.is_fd or len(data) > 8:
            counters["ignored"] += 1
            return
        self._bits += _BITS[len(data)]
        if self.state is not BusState.OK:
            self._recover(now)
        handler = self._handlers.get(message.arbitration_id)
        if handler is None:
            counters["unknown"] += 1
            return
        try:
            handler(data, now)
        except Exception:  # whatever a frame does to its handler, the next frame must be handled
            counters["broken_handlers"] += 1
            log.exception("bus %s: frame %s", self.name, message)

    def _recover(self, now: float) -> None:
        """A data frame has come: the bus is there; worries end when no error frame has come for a while."""
        if self.state in (BusState.GONE, BusState.BUS_OFF) or now - self._last_error > ERROR_MEMORY:
            self._mark(BusState.OK, "")

    def _mark(self, state: BusState, text: str) -> None:
        if state is not self.state:
            level = logging.INFO if state is BusState.OK else logging.WARNING
            log.log(level, "bus %s is %s. %s", self.name, state, text)
        self.state, self.text = state, text


def _error_state(message: can.Message, before: BusState) -> tuple[BusState, str]:
    """What an error frame in the format of Linux (linux/can/error.h) says of the bus."""
    kind = message.arbitration_id
    detail = message.data[1] if len(message.data) > 1 else 0
    if kind & 0x40:
        return BusState.BUS_OFF, "The controller is bus-off. Check wiring, termination and bit rate; set restart-ms."
    if kind & 0x100 or (kind & 0x04 and detail & 0x40):
        return BusState.OK, ""
    if kind & 0x04 and detail & 0x30:
        return BusState.PASSIVE, "The controller is error passive. Check wiring, termination and bit rate."
    if kind & 0x20:
        return max(before, BusState.WARNING, key=_SEVERITY.index), "Nobody acknowledges. Is any node powered?"
    return max(before, BusState.WARNING, key=_SEVERITY.index), f"Error frame of class {kind:03X}h."


_SEVERITY: list[BusState] = list(BusState)
