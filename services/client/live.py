"""Iterators over the messages of a robot, always the newest and never a backlog."""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Generic, Self, TypeVar

import zenoh

from services.wire import keys
from services.wire.messages import Message, Status
from services.wire.streams import Arrival, Reader

M = TypeVar("M", bound=Message)
DEADLINE = 2.0
"""An iterator waits this long [s] for the next message before it raises."""
FRESH = 0.25
"""A message is returned up to this age [s], on this machine's clock."""
FRESH_STATUS = 2.5
"""A status is returned up to this age [s]."""

Silence = Callable[[float], Exception]
"""A function of this type takes the time [s] in which nothing came, and returns the error to raise."""


class Live(Generic[M]):
    """Iterator whose `next` returns the newest message that was not returned yet, as soon as there is one.

    A slow caller skips some. A message older than `max_age` is not returned. It goes on when a service or a router was
    away; after an error `next` may be called again. For one thread.

    Args:
        reader: Reader of the messages.
        deadline: Time [s] to wait for a message; None waits without end.
        max_age: Largest age of a message [s].
        silence: Makes the error when none came in time.
    """

    def __init__(self, reader: Reader[M], deadline: float | None, max_age: float, silence: Silence) -> None:
        self._reader, self._deadline, self._max_age, self._silence = reader, deadline, max_age, silence
        self._returned: Arrival[M] | None = None

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> M:
        begun = time.monotonic()
        newest = self._reader.last()
        while newest is None or newest is self._returned or time.monotonic() - newest.received > self._max_age:
            left = None if self._deadline is None else begun + self._deadline - time.monotonic()
            arrival = self._reader.newer(newest, left) if left is None or left > 0 else None
            if arrival is None:
                raise self._silence(time.monotonic() - begun)
            newest = arrival
        self._returned = newest
        return newest.message


@dataclass(frozen=True, slots=True)
class Health:
    """Health of a robot's services.

    Attributes:
        alive: Names of live services; one that froze or was cut off counts for another second.
        statuses: Service -> its newest status, if that came in the last 2.5 s.
    """

    alive: frozenset[str] = frozenset()
    statuses: dict[str, Status] = field(default_factory=dict)


class Presence:
    """Set of a robot's live services, kept up to date by zenoh until the session ends."""

    def __init__(self, session: zenoh.Session, robot: str, changed: threading.Condition) -> None:
        """`changed` is notified of every service that comes or goes."""
        self._changed = changed
        self._alive: set[str] = set()
        self._subscriber = session.liveliness().declare_subscriber(keys.alive(robot, "*"), self._hear, history=True)

    def now(self) -> frozenset[str]:
        """Return the names of live services."""
        with self._changed:
            return frozenset(self._alive)

    def _hear(self, token: zenoh.Sample) -> None:
        service = keys.parse(str(token.key_expr))[1]
        with self._changed:
            (self._alive.add if token.kind == zenoh.SampleKind.PUT else self._alive.discard)(service)
            self._changed.notify_all()


class LiveHealth:
    """Iterator whose `next` returns the robot's health after a status, or after a service came or went.

    Meanwhile it waits, as `Live`; for a robot that vanishes it returns one health without live services. For one
    thread.

    Args:
        presence: Live services.
        readers: Readers of all services' statuses, which notify the same condition as `presence`.
        changed: That condition.
        deadline: Time [s] to wait; None waits without end.
        silence: Makes the error when nothing was heard in time.
    """

    def __init__(
        self,
        presence: Presence,
        readers: Iterable[Reader[Status]],
        changed: threading.Condition,
        deadline: float | None,
        silence: Silence,
    ) -> None:
        self._presence, self._readers, self._changed = presence, tuple(readers), changed
        self._deadline, self._silence = deadline, silence
        self._returned: tuple[object, ...] = (frozenset(), *(None for _ in self._readers))

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Health:
        begun = time.monotonic()
        with self._changed:
            heard = self._changed.wait_for(lambda: self._heard() != self._returned or self._has_ended(), self._deadline)
            if not heard or self._has_ended():
                raise self._silence(time.monotonic() - begun)
            self._returned = self._heard()
        fresh = [reader.get(FRESH_STATUS) for reader in self._readers]
        return Health(self._presence.now(), {status.service: status for status in fresh if status is not None})

    def _heard(self) -> tuple[object, ...]:
        """Return the live services and the arrival of each status, which differ after every change."""
        return (self._presence.now(), *(None if (last := r.last()) is None else last.received for r in self._readers))

    def _has_ended(self) -> bool:
        return any(reader.has_ended for reader in self._readers)
