"""A publisher that numbers its messages, and a reader that keeps only the newest message."""

import logging
import math
import threading
from typing import Any, Generic, NamedTuple, TypeVar

import zenoh

from hal.clock import Clock, SystemClock
from services.wire import messages
from services.wire.messages import Message, MessageError, OtherVersion
from services.wire.order import StreamOrder
from services.wire.plain_text import plain

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)


def bind(session: zenoh.Session, key: str, record: type[Message]) -> zenoh.Publisher:
    """Declare a zenoh publisher for one type of message; it drops messages when a receiver is slow."""
    encoding = zenoh.Encoding("application/msgpack").with_schema(f"gemuco.{record.TYPE}.v{messages.VERSION}")
    return session.declare_publisher(key, encoding=encoding, congestion_control=zenoh.CongestionControl.DROP)


def received_message(sample: zenoh.Sample, record: type[M]) -> M:
    """Decode a message of one type.

    Raises:
        MessageError: It is malformed, or was put on many keys at once (`gemuco/arm/**`), which our programs never do.
    """
    if "*" in str(sample.key_expr):
        raise MessageError(f"A {record.TYPE} message was put on many keys at once: '{plain(str(sample.key_expr))}'.")
    return messages.decode(sample.payload.to_bytes(), record)


class Publisher(Generic[M]):
    """A publisher of one type of message on one key. It numbers them and marks them with the process's `boot`."""

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
        """Whether the key has a subscriber right now."""
        status: Any = self._publisher.matching_status  # zenoh's stub says bool; it is an object, which is always true
        return bool(status.matching)


class Transit:
    """The delay of messages beyond the shortest delay seen.

    After a pause of the process or the link, queued messages arrive together and would look fresh by their time of
    arrival. The offset between the sender's wall clock and our monotonic clock is unknown, but the least difference
    belongs to the shortest delay, and any excess over it is delay. If a link becomes slower permanently, all messages
    count as late for a long time, because they look like old messages. A sender's clock that is seen to go back
    restarts the estimate; a clock set back during a silence looks like a slower link. A message that is older than one
    before must not come here (`services.wire.order`): it would look like a clock set back, and count as fresh.
    """

    DRIFT = 1e-3
    """The least difference grows by this rate [s/s], twice the slew rate of a clock, because clocks drift apart."""

    def __init__(self) -> None:
        self._stamp_ns, self._now, self._least = 0, -math.inf, math.inf

    def delay(self, stamp_ns: int, now: float) -> float:
        """Return the delay [s] of a message that arrives now (monotonic [s]); its stamp is the sender's clock [ns]."""
        if stamp_ns == 0:
            return 0.0
        difference = (round(now * 1e9) - stamp_ns) * 1e-9
        drifted = self._least if math.isinf(self._least) else self._least + self.DRIFT * (now - self._now)
        self._least = difference if stamp_ns < self._stamp_ns else min(difference, drifted)
        self._stamp_ns, self._now = stamp_ns, now
        return difference - self._least


class Arrival(NamedTuple, Generic[M]):
    """A message and its time of arrival.

    Attributes:
        message: The message as it was sent.
        received: Time of arrival less its delay [monotonic s of this process]. Ages count from here, because the clocks
            of two machines are never compared.
    """

    message: M
    received: float


class Reader(Generic[M]):
    """A subscriber that keeps the newest message of a key and its time of arrival.

    A thread takes messages from a ring of one, so a slow user neither delays the session nor reads old messages one by
    one. Malformed messages, and those that come twice or after newer ones, are counted and dropped. The thread ends
    with the session.

    Args:
        session: An open session.
        key: Key to subscribe to.
        record: Type of its messages.
        clock: Source of time.
        arrived: Notified of each message; one wait can cover all readers that share it.
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
        """This is the number of malformed messages, which were dropped."""
        self.rejected_text = ""
        """This is the error of the last of them."""
        self.order = StreamOrder()
        """This counts the messages that came twice or late; they were dropped."""
        self.has_ended = False
        """This is True once the session was closed."""
        self.arrived = arrived or threading.Condition()
        self._record = record
        self._clock = clock or SystemClock()
        self._newest: Arrival[M] | None = None
        self._other_version: tuple[float, str] | None = None
        self._disorder: tuple[float, str] | None = None
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        self._thread = threading.Thread(target=self._receive, name=f"newest {key}", daemon=True)
        self._thread.start()

    def get(self, max_age: float) -> M | None:
        """Return the newest message if it is at most `max_age` [s] old, counted from `Arrival.received`, else None."""
        newest = self._newest
        if newest is None or self._clock.monotonic() - newest.received > max_age:
            return None
        return newest.message

    def last(self) -> Arrival[M] | None:
        """Return the newest message of any age; None before the first."""
        return self._newest

    def other_version(self, max_age: float) -> str:
        """Return the error of a newest message of another version that came at most `max_age` [s] ago, else ""."""
        newest = self._other_version
        return "" if newest is None or self._clock.monotonic() - newest[0] > max_age else newest[1]

    def disorder(self, max_age: float) -> str:
        """Return the sentence about a message that came twice or late at most `max_age` [s] ago, else ""."""
        last = self._disorder
        return "" if last is None or self._clock.monotonic() - last[0] > max_age else last[1]

    def wait(self, timeout: float) -> M | None:
        """Wait for the next message to arrive; None if none does within `timeout` [s]."""
        arrival = self.newer(self._newest, timeout)
        return None if arrival is None else arrival.message

    def newer(self, than: Arrival[M] | None, timeout: float | None) -> Arrival[M] | None:
        """Wait until `last()` is not `than`; None if `timeout` [s] passes or the session ends first."""
        with self.arrived:
            self.arrived.wait_for(lambda: self._newest is not than or self.has_ended, timeout)
            return None if self._newest is than else self._newest

    def join(self, timeout: float) -> None:
        """Wait at most `timeout` [s] for the thread to end after the session was closed."""
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
                if text := self.order.problem_at(message, received):
                    self._disorder = (received, text)
                    continue
                received -= transit.delay(message.stamp_ns, received)
            except Exception as error:  # any error: the thread must go on to the next message
                self.rejected += 1
                self.rejected_text = str(error)
                if isinstance(error, OtherVersion):
                    self._other_version = (received, str(error))
                continue
            with self.arrived:
                self._newest, self._other_version = Arrival(message, received), None
                self.arrived.notify_all()
