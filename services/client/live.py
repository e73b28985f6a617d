"""Iterators over the newest messages of a robot; older messages are skipped."""

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
"""A function of this type takes the time without a message [s], and returns the error to raise."""


class Live(Generic[M]):
    """Iterator whose `next` waits for a new message and returns the newest.

    A slow caller skips messages. A message older than `max_age` is not returned. The iterator continues after a service
    or a router was absent; after an error `next` may be called again. For one thread.

    Args:
        reader: Reader of the messages.
        deadline: Time [s] to wait for a message; None waits without end.
        max_age: Largest age of a message [s].
        silence: Makes the error if no message came in time.
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
        alive: Names of live services; a frozen or disconnected service stays listed for another second.
        statuses: Service -> its newest status of the last 2.5 s.
    """

    alive: frozenset[str] = frozenset()
    statuses: dict[str, Status] = field(default_factory=dict)


class Presence:
    """Set of a robot's live services, updated by zenoh until the session ends."""

    def __init__(self, session: zenoh.Session, robot: str, changed: threading.Condition) -> None:
        """Notify `changed` of every service that starts or ends."""
        self._changed = changed
        self._alive: set[str] = set()
        self._subscriber = session.liveliness().declare_subscriber(keys.alive(robot, "*"), self._update, history=True)

    def now(self) -> frozenset[str]:
        """Return the names of live services."""
        with self._changed:
            return frozenset(self._alive)

    def _update(self, token: zenoh.Sample) -> None:
        service = keys.parse(str(token.key_expr))[1]
        with self._changed:
            (self._alive.add if token.kind == zenoh.SampleKind.PUT else self._alive.discard)(service)
            self._changed.notify_all()


class LiveHealth:
    """Iterator whose `next` waits for a status, or for a service that starts or ends, and returns the robot's health.

    When the last service ends, `next` returns a health without live services once. For one thread.

    Args:
        presence: Live services.
        readers: Readers of all services' statuses, which notify the same condition as `presence`.
        changed: The condition that all of them notify.
        deadline: Time [s] to wait; None waits without end.
        silence: Makes the error if nothing changed in time.
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
            has_changed = self._changed.wait_for(
                lambda: self._state() != self._returned or self._has_ended(), self._deadline
            )
            if not has_changed or self._has_ended():
                raise self._silence(time.monotonic() - begun)
            self._returned = self._state()
        fresh = [reader.get(FRESH_STATUS) for reader in self._readers]
        return Health(self._presence.now(), {status.service: status for status in fresh if status is not None})

    def _state(self) -> tuple[object, ...]:
        """Return the live services and the arrival time of each status."""
        return (self._presence.now(), *(None if (last := r.last()) is None else last.received for r in self._readers))

    def _has_ended(self) -> bool:
        return any(reader.has_ended for reader in self._readers)
