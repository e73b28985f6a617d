"""Messages in and out: a publisher that numbers them, and a reader that keeps only the newest."""

import logging
import math
import threading
from typing import Any, Generic, TypeVar

import zenoh

from hal.clock import Clock, SystemClock
from services import messages
from services.messages import Message, MessageError

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)


def bind(session: zenoh.Session, key: str, record: type[Message]) -> zenoh.Publisher:
    """A zenoh publisher for one type of message; it drops rather than blocks when a receiver is slow."""
    encoding = zenoh.Encoding("application/msgpack").with_schema(f"gemuco.{record.TYPE}.v{messages.VERSION}")
    return session.declare_publisher(key, encoding=encoding, congestion_control=zenoh.CongestionControl.DROP)


class Publisher(Generic[M]):
    """Publishes messages of one type on one key, numbered, and marked with the process's `boot`."""

    def __init__(self, session: zenoh.Session, key: str, record: type[M], boot: int) -> None:
        self.boot = boot
        self._publisher = bind(session, key, record)
        self._seq = 0

    def put(self, message: M) -> None:
        """Publish; `seq` and `boot` are filled in."""
        self._publisher.put(messages.encode(message, seq=self._seq, boot=self.boot))
        self._seq += 1

    @property
    def has_listener(self) -> bool:
        """Whether anybody subscribes to the key right now."""
        status: Any = self._publisher.matching_status  # zenoh's stub says bool, which it is not: it is always true
        return bool(status.matching)


class Transit:
    """How much longer than usual a message was on its way.

    A process or a link that stood still for a moment gets what piled up meanwhile, and its time of arrival alone would
    make that look fresh. The difference of the two wall clocks is not known between machines, but its least value of
    late stands for the shortest way; whatever a message has on top is delay. A wall clock that is set back makes all
    look delayed for at most two windows.
    """

    WINDOW = 5.0

    def __init__(self) -> None:
        self._until = -math.inf
        self._least = self._least_before = math.inf

    def delay(self, stamp_ns: int, now_ns: int, now: float) -> float:
        """Delay [s] of a message with this stamp that arrives now (wall clock [ns], monotonic [s])."""
        if stamp_ns == 0:
            return 0.0
        if now >= self._until:
            is_recent = now < self._until + self.WINDOW
            self._least_before = self._least if is_recent else math.inf
            self._least = math.inf
            self._until = now + self.WINDOW
        difference = (now_ns - stamp_ns) * 1e-9
        self._least = min(self._least, difference)
        return difference - min(self._least, self._least_before)


class Newest(Generic[M]):
    """The newest message of a key, and when it arrived here.

    A thread takes messages from a ring of one, so a slow user never delays the session, and never reads old messages
    one by one. Bytes that are not the message they should be are counted and dropped. Ends with the session.
    """

    def __init__(self, session: zenoh.Session, key: str, record: type[M], clock: Clock | None = None) -> None:
        self.key = key
        self.rejected = 0
        """Messages that were dropped because they could not be read."""
        self.rejected_text = ""
        """Why the last one could not be read."""
        self._record = record
        self._clock = clock or SystemClock()
        self._slot: tuple[float, M] | None = None
        self._arrived = threading.Condition()
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        threading.Thread(target=self._receive, name=f"newest {key}", daemon=True).start()

    def get(self, max_age: float) -> M | None:
        """The newest message if it arrived, or would have without delay, at most `max_age` [s] ago, else None."""
        slot = self._slot
        if slot is None or self._clock.monotonic() - slot[0] > max_age:
            return None
        return slot[1]

    def last(self) -> tuple[float, M] | None:
        """When the newest message arrived, or would have without delay [monotonic s], and the message; else None."""
        return self._slot

    def wait(self, timeout: float) -> M | None:
        """Wait for the next message to arrive; None if none does within `timeout` [s]."""
        with self._arrived:
            before = self._slot
            if not self._arrived.wait_for(lambda: self._slot is not before, timeout):
                return None
            return self._slot[1] if self._slot else None

    def _receive(self) -> None:
        transit = Transit()
        while True:
            try:
                sample = self._subscriber.recv()
            except zenoh.ZError:
                return  # the session was closed
            received, received_ns = self._clock.monotonic(), self._clock.now_ns()
            try:
                message = messages.decode(sample.payload.to_bytes(), self._record)
            except MessageError as error:
                self.rejected += 1
                self.rejected_text = str(error)
                continue
            received -= transit.delay(message.stamp_ns, received_ns, received)
            with self._arrived:
                self._slot = (received, message)
                self._arrived.notify_all()
