"""What every service process has: a lock, a session, a liveliness token, verbs, a status each second, an end."""

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import metadata
from types import TracebackType
from typing import Any, Self, TypeVar

import zenoh

from services.process.heartbeat import Heartbeat, Turning
from services.process.lock import ServiceLock
from services.wire import keys, query
from services.wire.messages import Message, Status
from services.wire.session import close_session, new_boot, open_session
from services.wire.streams import Publisher, Reader

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)

STATUS_EVERY = 1.0
STATUS_AT, STATUS_STEP = 0.0472, 0.1
"""A status is made so long [s] after a multiple of the step [s] on the clock: at usual rates no loop of the model
service begins near, and the HAL's turn has ended. One that met the update each second held up a twentieth of its ticks.
Which of the ten moments of a second it is depends on the start, so that services of a machine do not meet."""
ANSWERED_WITHIN = 0.5
"""How long [s] a service that ends still answers what it was asked before."""


class _Statuses:
    """The main thread's own turns, so that health sees it stand still too."""

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
        describe: What `describe` tells beyond pid, host and boot.

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
        self._asked = query.PendingQueries()
        self._statuses = _Statuses()
        self._watched: list[Turning] = [self._statuses]

    def __enter__(self) -> Self:
        self._lock.acquire()
        try:
            self._lock.check_router(self._connect)
            self.session = open_session(self.robot, self.name, self._connect)
            self._lock.check_network(self.session)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        self._token = self.session.liveliness().declare_token(keys.alive(self.robot, self.name))
        self._status = self.publisher(keys.status(self.robot, self.name), Status)
        self.verb("describe", lambda _: self.identity() | self.describe())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if hasattr(self, "session"):
            self._asked.wait(ANSWERED_WITHIN)
            close_session(self.session)
        self._lock.release()

    def identity(self) -> dict[str, Any]:
        """Who this is: robot, service, pid, host, boot, and the version of the package."""
        return {
            "robot": self.robot,
            "service": self.name,
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "boot": self.boot,
            "package": metadata.version("gemuco"),
        }

    def publisher(self, key: str, record: type[M]) -> Publisher[M]:
        """A publisher on this session, marked with this run's boot."""
        return Publisher(self.session, key, record, self.boot)

    def newest(self, key: str, record: type[M]) -> Reader[M]:
        """A reader of the newest message of a key."""
        return Reader(self.session, key, record)

    def verb(
        self, name: str, handler: query.Handler, guard: query.Guard | None = None, *, always: bool = False
    ) -> None:
        """Answer a verb until the session closes; see `query.serve_verb`."""
        query.serve_verb(self.session, keys.verb(self.robot, self.name, name), handler, guard, always, self._asked)

    def watch(self, *turning: Turning) -> None:
        """What has to go on for this service to be healthy, its loops above all. Call before `run`."""
        self._watched.extend(turning)

    def run(self, status: Callable[[], Status], stop: threading.Event) -> None:
        """Publish `status()` every second until `stop` is set, and once more as `stopping`.

        For as long as it lasts, health checks find out whether all that is watched goes on.
        """
        due = time.monotonic()
        with Heartbeat(self.name, self.robot, self._watched):
            while not stop.wait(max(0.0, due - time.monotonic())):
                self.publish_status(status)
                self._statuses.done += 1
                due = next_status(time.monotonic())
        self._status.put(Status(stamp_ns=time.time_ns(), service=self.name, state="stopping"))

    def publish_status(self, status: Callable[[], Status]) -> None:
        """Publish a status now; one that cannot be made is logged, and never ends the service."""
        try:
            self._status.put(status())
        except Exception:
            log.exception("No status of the '%s' service of robot '%s'", self.name, self.robot)


def next_status(now: float) -> float:
    """The moment for a status that is nearest to a period from now, both on the monotonic clock [s]."""
    wanted = now + STATUS_EVERY
    return wanted - ((wanted - STATUS_AT + 0.5 * STATUS_STEP) % STATUS_STEP - 0.5 * STATUS_STEP)


@contextmanager
def until_stopped(stop: threading.Event | None = None) -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set; the handlers before are put back at the end.

    Args:
        stop: An event of the caller's, who then ends the service himself; signals are left alone.
    """
    if stop is not None:
        yield stop
        return
    told = threading.Event()
    before = {number: signal.signal(number, lambda *_: told.set()) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
