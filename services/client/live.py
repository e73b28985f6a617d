"""Iterators over what a robot publishes, that always give the newest and never a backlog."""

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
"""How long [s] to wait for the next message before that is an error."""
FRESH = 0.25
"""Age [s], on this machine's clock, up to which a message is handed out; an older one is not."""
FRESH_STATUS = 2.5

Why = Callable[[float], Exception]
"""Takes how long [s] nothing came; returns the error that tells why."""


class Live(Generic[M]):
    """Each `next` is the newest message that was not given yet, as soon as there is one.

    Whoever is slow skips. Nothing older than `max_age` is given. It goes on when a service or a router was away; an
    error does not end it either, and `next` may be called again. For one thread.

    Args:
        reader: Where messages come in.
        deadline: How long [s] to wait for a message; None waits for ever.
        max_age: Age [s] up to which a message is given.
        why: The error when none came in time.
    """

    def __init__(self, reader: Reader[M], deadline: float | None, max_age: float, why: Why) -> None:
        self._reader, self._deadline, self._max_age, self._why = reader, deadline, max_age, why
        self._given: Arrival[M] | None = None

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> M:
        begun = time.monotonic()
        newest = self._reader.last()
        while newest is None or newest is self._given or time.monotonic() - newest.received > self._max_age:
            left = None if self._deadline is None else begun + self._deadline - time.monotonic()
            arrival = self._reader.newer(newest, left) if left is None or left > 0 else None
            if arrival is None:
                raise self._why(time.monotonic() - begun)
            newest = arrival
        self._given = newest
        return newest.message


@dataclass(frozen=True, slots=True)
class Health:
    """How a robot's services are.

    Attributes:
        alive: Names of the services that are there; one that froze or was cut off counts for another second.
        statuses: Service -> what it told last, if that was in the last 2.5 s.
    """

    alive: frozenset[str] = frozenset()
    statuses: dict[str, Status] = field(default_factory=dict)


class Presence:
    """Which services of a robot are alive, kept up to date by zenoh. Ends with the session."""

    def __init__(self, session: zenoh.Session, robot: str, changed: threading.Condition) -> None:
        """`changed` is notified of every service that comes or goes."""
        self._changed = changed
        self._alive: set[str] = set()
        self._subscriber = session.liveliness().declare_subscriber(keys.alive(robot, "*"), self._hear, history=True)

    def now(self) -> frozenset[str]:
        """Names of the services that are there."""
        with self._changed:
            return frozenset(self._alive)

    def _hear(self, token: zenoh.Sample) -> None:
        service = keys.parse(str(token.key_expr))[1]
        with self._changed:
            (self._alive.add if token.kind == zenoh.SampleKind.PUT else self._alive.discard)(service)
            self._changed.notify_all()


class LiveHealth:
    """Each `next` is the robot's health after something was heard: a status, a service that came or went.

    While nothing is heard it waits, like `Live`; a robot that vanishes is given once, as nobody alive. For one thread.

    Args:
        presence: Who is alive.
        readers: The readers of all services' statuses, which notify the same condition as `presence`.
        changed: That condition.
        deadline: How long [s] to wait; None waits for ever.
        why: The error when nothing was heard in time.
    """

    def __init__(
        self,
        presence: Presence,
        readers: Iterable[Reader[Status]],
        changed: threading.Condition,
        deadline: float | None,
        why: Why,
    ) -> None:
        self._presence, self._readers, self._changed = presence, tuple(readers), changed
        self._deadline, self._why = deadline, why
        self._given: tuple[object, ...] = (frozenset(), *(None for _ in self._readers))

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Health:
        begun = time.monotonic()
        with self._changed:
            heard = self._changed.wait_for(lambda: self._heard() != self._given or self._has_ended(), self._deadline)
            if not heard or self._has_ended():
                raise self._why(time.monotonic() - begun)
            self._given = self._heard()
        fresh = [reader.get(FRESH_STATUS) for reader in self._readers]
        return Health(self._presence.now(), {status.service: status for status in fresh if status is not None})

    def _heard(self) -> tuple[object, ...]:
        """What tells one moment from the next: who is alive, and when each status came."""
        return (self._presence.now(), *(None if (last := r.last()) is None else last.received for r in self._readers))

    def _has_ended(self) -> bool:
        return any(reader.has_ended for reader in self._readers)
