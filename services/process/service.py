"""The parts of every service process: a lock, a session, a liveliness token, verbs, a status each second, an end."""

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import metadata
from typing import Any, Self, TypeVar

import zenoh

from services.process.heartbeat import Activity, Heartbeat
from services.process.lock import ServiceLock
from services.process.realtime import share_heaps
from services.wire import keys, query
from services.wire.messages import Message, Status
from services.wire.session import close_session, new_boot, open_session
from services.wire.streams import Publisher, Reader

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)

STATUS_EVERY = 1.0
STATUS_AT, STATUS_STEP = 0.0472, 0.1
"""A status is published at `STATUS_AT` [s] after a multiple of `STATUS_STEP` [s] on the clock. At usual rates no loop
of the model service begins near that moment, and the HAL's tick has ended. A status at the time of the update delayed a
twentieth of its ticks. The start of the service selects one of the ten moments of a second, so that the services of a
machine differ."""
ANSWERED_WITHIN = 0.5
"""A service that ends still answers earlier queries for this time [s]."""


class _Statuses:
    """The activity of the main thread, so that a health check notices if it stops."""

    name, rate, error = "status", 1.0 / STATUS_EVERY, ""

    def __init__(self) -> None:
        self.done = 0


class Service:
    """One service of one robot, as a context manager.

    Entering takes the lock, opens the session, refuses a second service of the same kind, and declares the liveliness
    token and the verb `describe`.

    Args:
        robot: The robot's name.
        name: One of `keys.SERVICES`.
        connect: Endpoints, such as a router's, and role files.
        describe: Returns what `describe` answers beside the identity of the process.

    Attributes:
        session: The open zenoh session.
        boot: This run's random number.
    """

    session: zenoh.Session

    def __init__(
        self,
        robot: str,
        name: str,
        connect: Iterable[str] = (),
        describe: Callable[[], dict[str, Any]] = dict,
    ) -> None:
        self.robot, self.name = robot, name
        self.boot = new_boot()
        self._connect = tuple(connect)
        self.describe = describe
        self._lock = ServiceLock(robot, name)
        self._pending = query.PendingQueries()
        self._statuses = _Statuses()
        self._watched: list[Activity] = [self._statuses]

    def __enter__(self) -> Self:
        self._lock.acquire()
        try:
            share_heaps()
            self._lock.check_router(self._connect)
            self.session = open_session(self.robot, self.name, self._connect)
            self._lock.check_network(self.session)
        except BaseException:
            self.__exit__()
            raise
        self._token = self.session.liveliness().declare_token(keys.alive(self.robot, self.name))
        self._status = self.publisher(keys.status(self.robot, self.name), Status)
        self.verb("describe", lambda _: self.identity() | self.describe())
        return self

    def __exit__(self, *_: object) -> None:
        if hasattr(self, "session"):
            self._pending.wait(ANSWERED_WITHIN)
            close_session(self.session)
        self._lock.release()

    def identity(self) -> dict[str, Any]:
        """Return the identity of this process: robot, service, pid, host, boot, and the version of the package."""
        return {
            "robot": self.robot,
            "service": self.name,
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "boot": self.boot,
            "package": metadata.version("gemuco"),
        }

    def publisher(self, key: str, record: type[M]) -> Publisher[M]:
        """Make a publisher on this session, marked with this run's boot."""
        return Publisher(self.session, key, record, self.boot)

    def newest(self, key: str, record: type[M]) -> Reader[M]:
        """Make a reader of the newest message of a key."""
        return Reader(self.session, key, record)

    def verb(
        self, name: str, handler: query.Handler, guard: query.Guard | None = None, *, always: bool = False
    ) -> None:
        """Answer a verb until the session closes; see `query.serve_verb`."""
        query.serve_verb(self.session, keys.verb(self.robot, self.name, name), handler, guard, always, self._pending)

    def watch(self, *activities: Activity) -> None:
        """Add activities, such as loops, that must progress for this service to be healthy. Call before `run`."""
        self._watched.extend(activities)

    def run(self, status: Callable[[], Status], stop: threading.Event) -> None:
        """Publish `status()` every second until `stop` is set, then `stopping`; meanwhile write the heartbeat."""
        due = time.monotonic()
        with Heartbeat(self.name, self.robot, self._watched):
            while not stop.wait(max(0.0, due - time.monotonic())):
                self.publish_status(status)
                self._statuses.done += 1
                due = next_status(time.monotonic())
        self._status.put(Status(stamp_ns=time.time_ns(), service=self.name, state="stopping"))

    def publish_status(self, status: Callable[[], Status]) -> None:
        """Publish a status now; a failure is logged and never ends the service."""
        try:
            self._status.put(status())
        except Exception:
            log.exception("No status of the '%s' service of robot '%s'", self.name, self.robot)


def next_status(now: float) -> float:
    """Return the moment for a status that is nearest to one period from now [monotonic s]."""
    due = now + STATUS_EVERY
    return due - ((due - STATUS_AT + 0.5 * STATUS_STEP) % STATUS_STEP - 0.5 * STATUS_STEP)


@contextmanager
def until_stopped(stop: threading.Event | None = None) -> Iterator[threading.Event]:
    """Yield an event that SIGTERM and SIGINT set; restore the signal handlers at the end.

    Args:
        stop: Event to yield instead; signals are then not handled.
    """
    if stop is not None:
        yield stop
        return
    stopped = threading.Event()
    before = {number: signal.signal(number, lambda *_: stopped.set()) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
