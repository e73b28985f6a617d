"""Signals from topics of ROS 2: the newest values per element, each as old as it is, and every bad message counted."""

import logging
import math
import threading
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import zenoh

from hal.clock import Clock
from services.ros2 import cdr, messages, names
from services.ros2.cdr import BadBytes
from services.ros2.settings import SignalTopic
from services.wire.plain_text import plain
from services.wire.streams import Transit

log = logging.getLogger(__name__)

SOURCES = 16
"""At most this many publishers of a topic are distinguished."""
LARGEST = 1 << 16
"""Longer messages [bytes] are not read."""
FUTURE, LATE = 0.5, 1.0
"""A message may be stamped at most this far in the future, or in the past [s], by this machine's clock."""
OWNED_FOR = 1.0
"""An element belongs to the publisher that sent it, until this one was silent for this time [s]."""
NEWS_FOR = 5.0
"""The fault of a message is reported for this time [s]."""
LOG_EVERY = 1.0
HEADERLESS = (messages.NUMBERS,)


class Refused(Exception):
    """A message that is not used; `counter` names the reason."""

    def __init__(self, counter: str, text: str) -> None:
        super().__init__(text)
        self.counter = counter


class Target:
    """The newest values of one signal on a topic.

    Attributes:
        values: Values [the signal's unit], shape (n,); NaN before the first.
        received: Time of arrival less the delay [monotonic s], shape (n,); -inf before the first.
    """

    def __init__(self, topic: SignalTopic) -> None:
        size = len(topic.elements)
        self.values, self.received = np.full(size, np.nan), np.full(size, -np.inf)
        self._topic = topic
        self._owners: list[bytes] = [b""] * size
        self._places: tuple[tuple[str, ...], list[int]] | None = None

    def check(self, message: Mapping[str, Any]) -> list[float]:
        """Return the values of a message in the order of the elements; NaN for elements that it does not have.

        Raises:
            Refused: It has another size.
        """
        topic = self._topic
        if topic.kind == messages.JOINT_STATE:
            return self._of_joints(message)
        if topic.kind == messages.NUMBERS:
            if len(message["data"]) != len(topic.elements):
                raise Refused(
                    "size",
                    f"{len(message['data'])} numbers came, and {topic.signal} has {len(topic.elements)} elements",
                )
            return message["data"].tolist()
        vector = message["point"] if topic.field == "point" else message["wrench"][topic.field]
        return [vector[axis] for axis in topic.elements]

    def take(self, values: list[float], has: list[bool], received: float, source: bytes) -> int:
        """Take the elements that a message has; return the number of those that belong to another publisher."""
        doubled = 0
        for index, (value, is_there) in enumerate(zip(values, has, strict=True)):
            if not is_there:
                continue
            if self._owners[index] != source and received - self.received[index] < OWNED_FOR:
                doubled += 1
                continue
            self._owners[index] = source
            self.values[index], self.received[index] = value, received
        return doubled

    def has(self, message: Mapping[str, Any]) -> list[bool]:
        """Return whether a message has each element."""
        if self._topic.kind != messages.JOINT_STATE:
            return [True] * len(self._topic.elements)
        is_empty = not len(message[self._topic.field])
        return [not is_empty and index >= 0 for index in self._order(message["name"])]

    def _of_joints(self, message: Mapping[str, Any]) -> list[float]:
        numbers, joints = message[self._topic.field], message["name"]
        if len(numbers) not in (0, len(joints)):
            raise Refused(
                "size", f"a JointState has {len(joints)} names and {len(numbers)} values of {self._topic.field}"
            )
        order = self._order(joints)
        return [float(numbers[index]) if index >= 0 and len(numbers) else math.nan for index in order]

    def _order(self, joints: list[str]) -> list[int]:
        """Return the index of each element among these joints; -1 if it is not there."""
        key = tuple(joints)
        if self._places is None or self._places[0] != key:
            places = {joint: index for index, joint in enumerate(key)}
            self._places = key, [places.get(element, -1) for element in self._topic.elements]
        return self._places[1]


class Source:
    """One publisher of a topic.

    Attributes:
        waiting: Its newest message that was not read yet, with the time of arrival [monotonic s].
        stamp_ns: Stamp of its last message [ns since 1970].
    """

    def __init__(self) -> None:
        self.waiting: tuple[zenoh.Sample, float] | None = None
        self.stamp_ns = 0
        self.transit = Transit()


class Topic:
    """The newest messages of one topic.

    Args:
        name: Full name of the topic.
        kind: ROS type.
        topics: Its signals.
        clock: Clock of the HAL's cycle.

    Attributes:
        counters: Numbers of messages that were `used`, and of those that were not, by reason.
        targets: Signal -> its newest values.
    """

    def __init__(self, name: str, kind: str, topics: Iterable[SignalTopic], clock: Clock) -> None:
        self.name, self.kind = name, kind
        self.counters: Counter[str] = Counter()
        self.targets = {one.signal: Target(one) for one in topics}
        self._clock = clock
        self._sources: dict[bytes, Source] = {}
        self._lock = threading.Lock()
        self._text, self._text_at, self._logged_at = "", -math.inf, -math.inf

    def put(self, sample: zenoh.Sample) -> None:
        """Store a message until the cycle reads it; called by the session's thread."""
        now = self._clock.monotonic()
        gid = b"" if sample.attachment is None else sample.attachment.to_bytes()[-names.GID_SIZE :]
        with self._lock:
            source = self._sources.get(gid)
            if source is None:
                if len(self._sources) >= SOURCES:
                    self._sources.pop(next(iter(self._sources)))
                source = self._sources[gid] = Source()
            source.waiting = sample, now

    def update(self) -> None:
        """Read the waiting messages, the newest of each publisher; never raise because of one."""
        with self._lock:
            waiting = [(gid, source, source.waiting) for gid, source in self._sources.items() if source.waiting]
            for _, source, _ in waiting:
                source.waiting = None
        for gid, source, (sample, arrived) in waiting:
            try:
                self._read(sample, arrived, gid, source)
            except Refused as error:
                self._refuse(error.counter, str(error))
            except BadBytes as error:
                self._refuse("malformed", str(error).rstrip("."))
            except Exception as error:  # no message may end the cycle
                self._refuse("malformed", f"{type(error).__name__}: {error}")

    def news(self) -> str:
        """Return the fault of the last bad message for `NEWS_FOR`; empty otherwise."""
        return self._text if self._clock.monotonic() - self._text_at < NEWS_FOR else ""

    def _read(self, sample: zenoh.Sample, arrived: float, gid: bytes, source: Source) -> None:
        if len(sample.payload) > LARGEST:
            raise Refused("malformed", f"a message of {len(sample.payload)} bytes is longer than {LARGEST}")
        message = cdr.decode(self.kind, sample.payload.to_bytes())
        stamp_ns = self._stamp(message, sample)
        self._check_time(stamp_ns, source)
        checked = {name: (target.check(message), target.has(message)) for name, target in self.targets.items()}
        source.stamp_ns = stamp_ns
        received = arrived - source.transit.delay(stamp_ns, arrived)
        doubled, infinite = 0, 0
        for name, (values, has) in checked.items():
            doubled += self.targets[name].take(values, has, received, gid)
            infinite += sum(there and not math.isfinite(value) for value, there in zip(values, has, strict=True))
        self.counters["used"] += 1
        if infinite:
            self._refuse("not finite", f"{infinite} values are not finite and are not used")
        if doubled:
            self._refuse("doubled", f"{doubled} values come from two publishers; those of the first are used")

    def _stamp(self, message: Mapping[str, Any], sample: zenoh.Sample) -> int:
        """Return the time of measurement [ns since 1970], or that of publication; 0 if neither is given."""
        stamp_ns = 0 if self.kind in HEADERLESS else messages.time_ns(message["header"]["stamp"])
        if stamp_ns or sample.attachment is None:
            return stamp_ns
        return names.read_attachment(sample.attachment.to_bytes())[1]

    def _check_time(self, stamp_ns: int, source: Source) -> None:
        if not stamp_ns:
            return
        ahead = (stamp_ns - self._clock.now_ns()) * 1e-9
        hint = "Are the clocks of both machines set?"
        if ahead > FUTURE:
            raise Refused("future", f"a message is stamped {ahead:.1f} s in the future and is not used. {hint}")
        if -ahead > LATE:
            raise Refused("late", f"a message is stamped {-ahead:.1f} s in the past and is not used. {hint}")
        if stamp_ns <= source.stamp_ns:
            raise Refused("repeated", "a message is not newer than the one before, and is not used")

    def _refuse(self, counter: str, text: str) -> None:
        self.counters[counter] += 1
        self._text = f"Topic '{self.name}': {plain(text)}" + ("" if text.endswith(("?", ".")) else ".")
        self._text_at = now = self._clock.monotonic()
        if now - self._logged_at >= LOG_EVERY:
            self._logged_at = now
            log.warning("%s (%d so far)", self._text, self.counters[counter])


def topics_by_name(topics: Iterable[SignalTopic], clock: Clock) -> dict[str, Topic]:
    """Return one `Topic` for each name, with all its signals."""
    by_name: dict[str, list[SignalTopic]] = {}
    for one in topics:
        by_name.setdefault(one.topic, []).append(one)
    return {name: Topic(name, parts[0].kind, parts, clock) for name, parts in by_name.items()}
