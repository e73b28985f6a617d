"""One serial line of servos, with a thread that asks all of them in every cycle and survives a pulled plug.

A line is half duplex and has one master: the thread sends the set-points of all servos in one packet, asks for the
measurements of all in another, and reads their answers. The cycle only hands over packets and waits for the answers.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from hal.clock import BusClock
from hal.config import BusConfig
from hal.errors import ConfigError, HalError
from hal.line.port import Port
from hal.log_limit import LogLimit
from hal.protocols.serial_status import Packets, Status, StatusReader
from hal.wire.state import UNUSABLE, BusState, BusWatch, ThreadWatch

log = logging.getLogger(__name__)

ANSWER_TIME, SLOW_ANSWER_TIME = 0.004, 0.02
"""A servo begins its answer within this time [s]; the second is for an adapter that keeps bytes for milliseconds."""
SILENCE = 1.0
"""The port is opened again after this time [s] of requests without an answer, because it may have been replaced."""
BACK_OFF = (0.05, 0.5)
"""Attempts to open have these first and longest pauses [s]."""
MISSES_FORGIVEN = 4
"""A servo that missed this number of cycles in sequence is asked alone, one in each cycle, until it answers again."""
IDLE = 0.05
"""Without a cycle for this time [s], requests are sent at once and not after the next cycle."""
REQUEST_PATIENCE = 0.5
"""A request waits at most this time [s] for its turn."""
STATISTICS_PERIOD = 1.0
MOST_STRANGERS = 8
COUNTERS = ("received", "sent", "unknown", "skipped", "asked_again", "opened", "failures")
BITS = 10
"""A byte has this number of bits on the line: start, 8 data, stop."""


class LineServo(Protocol):
    """A servo on a line, as the line uses it."""

    node: int
    missed: int
    """Number of cycles since its last answer."""
    patience: int
    is_commissioned: bool
    packets: Packets
    feedback: tuple[int, int]
    """First register and number of bytes that are read in every cycle."""
    state: tuple[int, int] | None
    """Registers that are read of one servo per cycle; None if the feedback has them."""
    is_changing: bool
    """Whether its state is read before that of others."""

    def outgoing(self) -> Sequence[tuple[int, bytes]]:
        """Return and forget (address, data) to write in this cycle, in order."""
        ...

    def take_feedback(self, status: Status, received: float) -> None:
        """Handle the answer to the feedback; called in the line's thread."""
        ...

    def take_state(self, status: Status, received: float) -> None:
        """Handle the answer to the state; called in the line's thread."""
        ...


@dataclass(slots=True)
class _Cycle:
    writes: list[bytes] = field(default_factory=list)
    groups: dict[tuple[int, int], list[LineServo]] = field(default_factory=dict)
    straggler: LineServo | None = None
    state_of: LineServo | None = None


@dataclass(slots=True)
class _Request:
    packet: bytes
    node: int
    size: int
    done: threading.Event = field(default_factory=threading.Event)
    status: Status | None = None
    is_dropped: bool = False


class SerialLine:
    """A serial line that stays usable as an object while its adapter fails and returns."""

    def __init__(self, name: str, config: BusConfig, clock: BusClock) -> None:
        self.name = name
        self.counters = dict.fromkeys(COUNTERS, 0)
        self.needs_sync = False
        """Unused: a line has no SYNC of its own."""
        self._config = config
        self._clock = clock
        self._log = LogLimit(log)
        self._watch = BusWatch(self._changed)
        self._thread_watch = ThreadWatch()
        self._losses = 0
        self._servos: list[LineServo] = []
        self._by_node: dict[int, LineServo] = {}
        self._packets: Packets | None = None
        self._reader: StatusReader | None = None
        self._waiting: set[LineServo] = set()
        self._answered = threading.Event()
        self._tried = threading.Event()
        self._closing = threading.Event()
        self._wake = threading.Event()
        self._cycle: _Cycle | None = None
        self._requests: deque[_Request] = deque()
        self._synced = self._heard = self._asked = 0.0
        self._turns = 0
        self._thread: threading.Thread | None = None
        self._answer_time = ANSWER_TIME
        self._bytes = 0
        self._load = 0.0
        self._statistics_due = 0.0
        self._strangers: dict[int, None] = {}

    @property
    def state(self) -> BusState:
        """State of the line."""
        return self._watch.state

    @property
    def text(self) -> str:
        """Problem and remedy in one sentence for the operator; empty without a problem."""
        return self._watch.text

    @property
    def is_receiving(self) -> bool:
        """Whether the thread is alive and had a turn recently."""
        thread = self._thread
        return thread is not None and thread.is_alive() and self._thread_watch.is_turning

    def expect(self, servo: LineServo) -> None:
        """Ask a servo in every cycle from now on, once it is commissioned.

        Raises:
            ConfigError: Its id is out of range, or the line has servos of another protocol.
        """
        packets = servo.packets
        if not 0 <= servo.node <= packets.HIGHEST_NODE:
            raise ConfigError(
                f"Node {servo.node} on line '{self.name}': the id of a {packets.NAME} servo is 0 to "
                f"{packets.HIGHEST_NODE}."
            )
        if self._packets is None:
            self._packets, self._reader = packets, packets.reader()
        elif self._packets is not packets:
            raise ConfigError(
                f"Line '{self.name}' has servos of {self._packets.NAME} and of {packets.NAME}, which do not understand "
                "each other. Give each make a line of its own."
            )
        self._servos.append(servo)
        self._by_node[servo.node] = servo

    def answered(self, servo: LineServo) -> None:
        """Note the answer of a servo in this cycle; called in the line's thread."""
        waiting = self._waiting
        waiting.discard(servo)
        if not waiting:
            self._answered.set()

    def open(self) -> None:
        """Start the thread, and return after the first attempt to open the port, also if it failed."""
        self._closing.clear()
        self._tried.clear()
        self._thread_watch.start()
        self._thread = threading.Thread(target=self._run, name=f"line {self.name}", daemon=True)
        self._thread.start()
        self._tried.wait(5.0)

    def close(self) -> None:
        """Send what waits, end the thread and close the port. Safe to call twice."""
        self._closing.set()
        self._wake.set()
        if self._thread:
            self._thread.join()
            self._thread = None

    def begin(self) -> None:
        """Begin a cycle, before the first set-point."""
        self._waiting = {s for s in self._servos if s.is_commissioned and s.missed < MISSES_FORGIVEN}
        self._answered.clear()
        if self._thread_watch.hangs() and self.state is not BusState.GONE:
            self._watch.lost("Its thread hangs. Is the adapter still plugged in?")

    def sync(self, now: float) -> None:
        """Hand the set-points of this cycle to the thread, which sends them and asks all servos.

        Args:
            now: Time of the cycle [monotonic s].
        """
        cycle, packets = _Cycle(), self._packets
        if packets is None:
            return
        self._turns += 1
        writes: dict[tuple[int, int, int], dict[int, bytes]] = {}
        stragglers: list[LineServo] = []
        for servo in self._servos:
            for step, (address, data) in enumerate(servo.outgoing()):
                writes.setdefault((step, address, len(data)), {})[servo.node] = data
            if not servo.is_commissioned:
                continue
            if servo.missed < MISSES_FORGIVEN:
                cycle.groups.setdefault(servo.feedback, []).append(servo)
            else:
                stragglers.append(servo)
        cycle.writes = [
            packets.sync_write(address, data)
            for (_, address, _), data in sorted(writes.items(), key=lambda at: at[0][0])
        ]
        cycle.straggler = stragglers[self._turns % len(stragglers)] if stragglers else None
        with_state = [s for group in cycle.groups.values() for s in group if s.state is not None]
        with_state = [s for s in with_state if s.is_changing] or with_state
        cycle.state_of = with_state[self._turns % len(with_state)] if with_state else None
        if self._cycle is not None:
            self.counters["skipped"] += 1  # its set-points are old, and a torque is switched again in every cycle
        self._cycle, self._synced = cycle, now
        self._wake.set()

    def wait(self, deadline: float) -> bool:
        """Wait for the answers of all servos until the deadline [monotonic s], and return whether all answered."""
        waiting = self._waiting
        while waiting and self._clock.wait(self._answered, deadline):
            self._answered.clear()
        complete = not waiting
        for servo in self._servos:
            servo.missed += 1
            complete &= servo.missed <= servo.patience
        return complete

    def request(self, packet: bytes, node: int, size: int) -> Status | None:
        """Send a packet to one servo and return its answer; None without one. Blocks; never called from the cycle.

        Args:
            packet: The packet.
            node: Id of the servo that answers.
            size: Number of data bytes in its answer.
        """
        request = _Request(packet, node, size)
        self._requests.append(request)
        self._wake.set()
        if not request.done.wait(REQUEST_PATIENCE):
            request.is_dropped = True
        return request.status

    def trouble(self) -> str:
        """Return the problem that made the line unusable now or since the last call; empty without one."""
        watch = self._watch
        losses, self._losses = self._losses, watch.losses
        return watch.lost_by if watch.state in UNUSABLE or watch.losses != losses else ""

    def health(self) -> dict[str, Any]:
        """Return state, problem, load as a share of the bit rate, and counters."""
        reader = self._reader
        seen = {"malformed": reader.malformed, "echoes": reader.echoes} if reader else {}
        return {
            "state": self.state.value,
            "text": self.text,
            "load": round(self._load, 4),
            "is_receiving": self.is_receiving,
            "stamps": "arrival",
            "error_counters": None,
            "unknown": [f"servo {node}" for node in self._strangers][:MOST_STRANGERS],
            "counters": {**self.counters, **seen},
        }

    def _run(self) -> None:
        pause = BACK_OFF[0]
        while not self._closing.is_set():
            received = self.counters["received"]
            port = None
            try:
                port = Port(self._config.interface, self._config.channel, self._config.bitrate)
                self._opened(port)
                self._serve(port)
            except Exception as error:  # an adapter's driver may raise anything, and this thread must survive
                self.counters["failures"] += 1
                text = f"{error if isinstance(error, HalError) else repr(error)} Trying again."
                self._watch.lost(text)
                if self.counters["failures"] == 1 and not self.counters["opened"]:
                    self._changed(BusState.GONE, text)  # a line begins in this state, so it is no change
                log.debug("line %s", self.name, exc_info=True)
            if port is not None:
                port.close()
            self._tried.set()
            self._give_up_requests()
            pause = BACK_OFF[0] if self.counters["received"] > received else min(2 * pause, BACK_OFF[1])
            self._closing.wait(pause)
        self._watch.lost("Closed.")

    def _opened(self, port: Port) -> None:
        self._answer_time = SLOW_ANSWER_TIME if port.is_slow else ANSWER_TIME
        self._watch.opened("Open, but no servo has answered yet. Are they powered, are bit rate and ids right?")
        self.counters["opened"] += 1
        self._heard = self._asked = self._clock.monotonic()
        self._cycle = None  # its set-points are from before
        self._tried.set()

    def _serve(self, port: Port) -> None:
        """Run cycles and requests until the line is closed, or silent.

        Raises:
            BusGone: The adapter is gone.
            ConnectionError: No servo answers.
        """
        monotonic = self._clock.monotonic
        while True:
            self._wake.wait(IDLE)
            self._wake.clear()
            if self._thread_watch.turn():
                port.drain()
            cycle, self._cycle = self._cycle, None
            if cycle is not None:
                self._exchange(port, cycle)
            elif self._closing.is_set():
                return
            is_idle = cycle is None and monotonic() - self._synced > IDLE
            if cycle is not None or is_idle:
                self._serve_request(port)
            if self._cycle is not None or (is_idle and self._requests):
                self._wake.set()
            self._update_statistics(monotonic())
            if self._asked - self._heard > SILENCE:
                raise ConnectionError(f"No servo has answered for {self._asked - self._heard:.1f} s. Are they powered?")

    def _exchange(self, port: Port, cycle: _Cycle) -> None:
        for packet in cycle.writes:
            self._send(port, packet)
        for (address, size), servos in cycle.groups.items():
            self._read_group(port, address, size, servos)
        packets = self._packets
        assert packets is not None, "a line with a cycle has servos"
        servo = cycle.straggler
        if servo is not None:
            status = self._ask(port, packets.read(servo.node, *servo.feedback), servo.node, servo.feedback[1])
            if status is not None:
                servo.take_feedback(status, self._clock.monotonic())
        servo = cycle.state_of
        if servo is not None and servo.state is not None and servo.missed < MISSES_FORGIVEN:
            status = self._ask(port, packets.read(servo.node, *servo.state), servo.node, servo.state[1])
            if status is not None:
                servo.take_state(status, self._clock.monotonic())

    def _read_group(self, port: Port, address: int, size: int, servos: Sequence[LineServo]) -> None:
        """Ask several servos; one that is missing keeps those after it silent, so these are asked once more."""
        pending = list(servos)
        for is_again in (False, True):
            packet = self._packets.sync_read([servo.node for servo in pending], address, size)  # type: ignore[union-attr]
            left = {servo.node: servo for servo in pending}
            self._begin(port, packet)
            for status, received in self._statuses(port, packet, len(left), size):
                servo = left.pop(status.node, None)
                if servo is None:
                    self._stranger(status.node)
                elif len(status.data) == size:
                    servo.take_feedback(status, received)
                if not left:
                    return
            pending = pending[pending.index(next(iter(left.values()))) + 1 :]
            pending = [servo for servo in pending if servo.node in left]
            if is_again or not pending:
                return
            self.counters["asked_again"] += 1

    def _ask(self, port: Port, packet: bytes, node: int, size: int) -> Status | None:
        """Return the answer of one servo; None without one, or with one of another size."""
        self._begin(port, packet)
        for status, _ in self._statuses(port, packet, 1, size):
            if status.node == node:
                return status if len(status.data) == size else None
            self._stranger(status.node)
        return None

    def _statuses(self, port: Port, packet: bytes, count: int, size: int) -> Any:
        """Yield (status, time of arrival) until no byte came for the time in which a servo answers."""
        reader, monotonic = self._reader, self._clock.monotonic
        assert reader is not None and self._packets is not None, "a line with a request has servos"
        per_byte = BITS / self._config.bitrate
        gap = self._answer_time + per_byte * (self._packets.OVERHEAD + size)
        deadline = monotonic() + per_byte * len(packet) + gap
        while count > 0:
            received = port.read(deadline - monotonic())
            now = monotonic()
            if not received:
                return
            self._bytes += len(received)
            deadline = now + gap
            for status in reader.feed(received):
                self.counters["received"] += 1
                self._heard = now
                if self._watch.state is not BusState.OK:
                    self._watch.heard(now)
                count -= 1
                yield status, now

    def _begin(self, port: Port, packet: bytes) -> None:
        """Forget late answers, and send a packet that is answered."""
        port.drain()
        if self._reader is not None:
            self._reader.clear()
        self._send(port, packet)
        self._asked = self._clock.monotonic()

    def _send(self, port: Port, packet: bytes) -> None:
        port.write(packet)
        if self._reader is not None:
            self._reader.sent(packet)
        self.counters["sent"] += 1
        self._bytes += len(packet)

    def _serve_request(self, port: Port) -> None:
        while self._requests:
            request = self._requests.popleft()
            if request.is_dropped:
                continue
            request.status = self._ask(port, request.packet, request.node, request.size)
            if request.status is None:
                port.read(self._answer_time)  # an answer that is late must not be taken for that to the next request
            request.done.set()
            return

    def _give_up_requests(self) -> None:
        while self._requests:
            self._requests.popleft().done.set()

    def _stranger(self, node: int) -> None:
        if node not in self._by_node:
            self.counters["unknown"] += 1
            self._strangers[node] = None

    def _update_statistics(self, now: float) -> None:
        if now < self._statistics_due:
            return
        passed = now - self._statistics_due + STATISTICS_PERIOD
        self._load = self._bytes * BITS / self._config.bitrate / passed
        self._bytes = 0
        self._statistics_due = now + STATISTICS_PERIOD

    def _changed(self, state: BusState, text: str) -> None:
        is_expected = state is BusState.OK or self._closing.is_set()
        level = logging.INFO if is_expected else logging.WARNING
        self._log.line(level, state, time.monotonic(), f"line {self.name} is {state}. {text}")
