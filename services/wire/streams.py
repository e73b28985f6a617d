"""Messages in and out: a publisher that numbers them, and a reader that keeps only the newest."""

import logging
import math
import threading
from typing import Any, Generic, NamedTuple, TypeVar

import zenoh

from hal.clock import Clock, SystemClock
from services.wire import messages
from services.wire.messages import Message, MessageError, OtherVersion
from services.wire.plain_text import plain

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)


def bind(session: zenoh.Session, key: str, record: type[Message]) -> zenoh.Publisher:
    """A zenoh publisher for one type of message; it drops rather than blocks when a receiver is slow."""
    encoding = zenoh.Encoding("application/msgpack").with_schema(f"gemuco.{record.TYPE}.v{messages.VERSION}")
    return session.declare_publisher(key, encoding=encoding, congestion_control=zenoh.CongestionControl.DROP)


def received_message(sample: zenoh.Sample, record: type[M]) -> M:
    """The message of one type that came on a key.

    Raises:
        MessageError: It is none, or was put on many keys at once (`gemuco/arm/**`), which no honest sender does.
    """
    if "*" in str(sample.key_expr):
        raise MessageError(f"A {record.TYPE} message was put on many keys at once: '{plain(str(sample.key_expr))}'.")
    return messages.decode(sample.payload.to_bytes(), record)


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
    make that look fresh. How far the sender's wall clock is from our monotonic one is not known, but the least
    difference stands for the shortest way; whatever a message has on top is delay. A link that becomes slower for good
    therefore makes all late for long: nobody can tell that from old messages. Only a wall clock that is seen to go
    back starts anew; set back during a silence, it looks like such a link.
    """

    DRIFT = 1e-3
    """How fast [s/s] the least difference is forgotten: twice as fast as a clock is slewed, for clocks drift apart."""

    def __init__(self) -> None:
        self._stamp_ns, self._now, self._least = 0, -math.inf, math.inf

    def delay(self, stamp_ns: int, now: float) -> float:
        """Delay [s] of a message with this stamp (sender's wall clock [ns]) that arrives now (monotonic [s])."""
        if stamp_ns == 0:
            return 0.0
        difference = (round(now * 1e9) - stamp_ns) * 1e-9
        forgotten = self._least if math.isinf(self._least) else self._least + self.DRIFT * (now - self._now)
        self._least = difference if stamp_ns < self._stamp_ns else min(difference, forgotten)
        self._stamp_ns, self._now = stamp_ns, now
        return difference - self._least


class Arrival(NamedTuple, Generic[M]):
    """A message and its time of arrival.

    Attributes:
        message: The message as it was sent.
        received: Time of arrival, without its delay on the way [monotonic s of this process]; ages count from here, for
            the clocks of two machines are never compared.
    """

    message: M
    received: float


class Reader(Generic[M]):
    """A subscriber that keeps the newest message of a key, and its time of arrival.

    A thread takes messages from a ring of one, so a slow user never delays the session, and never reads old messages
    one by one. Bytes that are not the message they should be are counted and dropped. Ends with the session.

    Args:
        session: An open session.
        key: What to subscribe to.
        record: What comes there.
        clock: What time it is.
        arrived: What to notify of a message; readers that share one can be waited for together.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        record: type[M],
        clock: Clock | None = None,
        arrived: threading.Condition | None = None,
    ) -> None:
        self.key = key
        self.rejected = 0
        """Messages that were dropped because they could not be read."""
        self.rejected_text = ""
        """Why the last one could not be read."""
        self.has_ended = False
        """Whether the session was closed."""
        self.arrived = arrived or threading.Condition()
        self._record = record
        self._clock = clock or SystemClock()
        self._newest: Arrival[M] | None = None
        self._other_version: tuple[float, str] | None = None
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        self._thread = threading.Thread(target=self._receive, name=f"newest {key}", daemon=True)
        self._thread.start()

    def get(self, max_age: float) -> M | None:
        """The newest message if it arrived, or would have without delay, at most `max_age` [s] ago, else None."""
        newest = self._newest
        if newest is None or self._clock.monotonic() - newest.received > max_age:
            return None
        return newest.message

    def last(self) -> Arrival[M] | None:
        """Return the newest message, however old; None before the first."""
        return self._newest

    def other_version(self, max_age: float) -> str:
        """What is wrong with the newest message if it is of another version and came at most `max_age` [s] ago."""
        found = self._other_version
        return "" if found is None or self._clock.monotonic() - found[0] > max_age else found[1]

    def wait(self, timeout: float) -> M | None:
        """Wait for the next message to arrive; None if none does within `timeout` [s]."""
        arrival = self.newer(self._newest, timeout)
        return None if arrival is None else arrival.message

    def newer(self, than: Arrival[M] | None, timeout: float | None) -> Arrival[M] | None:
        """Wait until `last()` is another one than this; None if `timeout` [s] passes or the session ends first."""
        with self.arrived:
            self.arrived.wait_for(lambda: self._newest is not than or self.has_ended, timeout)
            return None if self._newest is than else self._newest

    def join(self, timeout: float) -> None:
        """Wait until the thread has ended, after the session was closed, at most `timeout` [s]."""
        self._thread.join(timeout)

    def _receive(self) -> None:
        transit = Transit()
        while True:
            try:
                sample = self._subscriber.recv()
            except zenoh.ZError:  # the session was closed
                with self.arrived:
                    self.has_ended = True
                    self.arrived.notify_all()
                return
            received = self._clock.monotonic()
            try:
                message = received_message(sample, self._record)
                received -= transit.delay(message.stamp_ns, received)
            except Exception as error:  # whatever it is, the next message is to be read
                self.rejected += 1
                self.rejected_text = str(error)
                if isinstance(error, OtherVersion):
                    self._other_version = (received, str(error))
                continue
            with self.arrived:
                self._newest, self._other_version = Arrival(message, received), None
                self.arrived.notify_all()
