"""Snapshots of all robots of a network, from their liveliness tokens, statuses and lease holders.

These are 2 to 4 kB per robot and second, whatever the rates of its loops.
"""

import re
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import zenoh

from hal.clock import Clock, SystemClock
from services.runtime import services_here
from services.watch.service_rows import needed
from services.watch.snapshot import Newest, RobotSnapshot
from services.wire import keys
from services.wire.member import member_of
from services.wire.messages import Holder, Message, MessageError, Status
from services.wire.order import Order
from services.wire.session import CLIENT, close_session, endpoint, open_with, settings
from services.wire.streams import received_message

M = TypeVar("M", bound=Message)

TWIN_FOR = 5.0
"""Two processes that publish one status in turns count as two for this time [s]."""
FORGET_AFTER = 600.0
"""A robot that has gone stays listed for this time [s]."""
MOST = 5000
"""At most this number of robots is kept; a client that invents names cannot fill the memory."""
ROBOT = re.compile(r"[a-z][a-z0-9_]{0,99}$")
"""Robot files allow these names."""
WHO = "gemuco top"


@dataclass(slots=True)
class ServiceRecord:
    """Messages of one service of a robot.

    Attributes:
        status: Newest status; None before the first.
        received: Arrival of that status [monotonic s].
        is_alive: Whether the liveliness token is present.
        boots: Boot of each process -> arrival of its newest status [monotonic s].
        twin_until: Time until which two processes count as publishing under this name [monotonic s].
        order: Order of the statuses of each process.
    """

    status: Status | None = None
    received: float = -1e9
    is_alive: bool = False
    boots: dict[int, float] = field(default_factory=dict)
    twin_until: float = -1e9
    order: Order = field(default_factory=Order)

    def add(self, status: Status, now: float) -> None:
        """Add a status; a new boot after the old one is a restart, boots in turns are two processes.

        A status that came before, or after a newer one of its process, is left out.
        """
        if self.order.problem(status):
            return
        last = self.status.boot if self.status is not None else status.boot
        if status.boot != last and now - self.boots.get(status.boot, -1e9) < TWIN_FOR:
            self.twin_until = now + TWIN_FOR
        self.boots = {boot: at for boot, at in self.boots.items() if now - at < TWIN_FOR} | {status.boot: now}
        self.status, self.received = status, now


class RobotRecord:
    """Messages of one robot."""

    def __init__(self, robot: str, now: float) -> None:
        self.robot = robot
        self.services: dict[str, ServiceRecord] = {}
        self.holder: tuple[float, Holder] | None = None
        self.holders = Order()
        self.active_at = now
        """The last message or token of the robot arrived at this time [monotonic s]."""

    def service(self, name: str) -> ServiceRecord:
        """Return the record of a service, made at the first call."""
        return self.services.setdefault(name, ServiceRecord())

    @property
    def alive(self) -> frozenset[str]:
        """Names of the live services."""
        return frozenset(name for name, service in self.services.items() if service.is_alive)

    def snapshot(self, now: float) -> RobotSnapshot:
        """Return everything that is known of the robot now [monotonic s]."""
        statuses = {
            name: Newest(service.status, max(0.0, now - service.received))
            for name, service in self.services.items()
            if service.status is not None
        }
        return RobotSnapshot(
            robot=self.robot,
            has_streams=False,
            alive=self.alive,
            twins=tuple(name for name, service in self.services.items() if now < service.twin_until),
            holder=None if self.holder is None else Newest(self.holder[1], max(0.0, now - self.holder[0])),
            statuses=statuses,
        )

    def is_complete(self, now: float) -> bool:
        """Whether the needed services are alive, and every live service has published its status."""
        snapshot = self.snapshot(now)
        return set(needed(snapshot)) <= snapshot.alive <= set(snapshot.statuses)


class FleetWatch:
    """Subscriber to all robots of the router or role file in `connect`; without it to those of this machine.

    A context manager. There is no discovery on one machine: robots are found by their locks, so call `look` repeatedly.

    Args:
        connect: Endpoints, such as a router's, and role files.
        clock: Clock of the ages.
    """

    def __init__(self, connect: Iterable[str] = (), clock: Clock | None = None) -> None:
        self.rejected = 0
        """Number of messages that could not be read."""
        self.strange = 0
        """Number of messages from unknown services, or from more robots than are kept."""
        self._connect = tuple(connect)
        self._clock = clock or SystemClock()
        self._lock = threading.Lock()
        self._robots: dict[str, RobotRecord] = {}
        self._here: list[tuple[str, str]] = []
        self._session: zenoh.Session | None = None
        self._subscribers: list[Any] = []

    def __enter__(self) -> "FleetWatch":
        self._open()
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    @property
    def has_router(self) -> bool:
        """Whether the router in `connect` is linked; true without `connect`."""
        return not self._connect or (self._session is not None and bool(list(self._session.info.routers_zid())))

    def look(self) -> None:
        """Connect to services that were started on this machine meanwhile."""
        if not self._connect and set(services_here()) - set(self._here):
            self._close()
            self._open()

    def snapshots(self) -> list[RobotSnapshot]:
        """Return a snapshot of each robot."""
        now = self._clock.monotonic()
        with self._lock:
            for name, robot in list(self._robots.items()):
                if now - robot.active_at > FORGET_AFTER and not robot.alive:
                    del self._robots[name]
            return [robot.snapshot(now) for robot in self._robots.values()]

    def is_complete(self) -> bool:
        """Whether there is a robot, and of every robot the needed services and the status of each live one."""
        now = self._clock.monotonic()
        with self._lock:
            return bool(self._robots) and all(robot.is_complete(now) for robot in self._robots.values())

    def _open(self) -> None:
        self._here = [] if self._connect else services_here()
        configuration = settings("", CLIENT, self._connect)
        if not self._connect:
            configuration["connect"]["endpoints"] = [endpoint(robot, service) for robot, service in self._here]
        self._session = session = open_with(configuration, WHO)
        # The robots of a role file, because a wider subscription than the role allows receives nothing; else all.
        for robot in member_of(self._connect).robots or ("*",):
            self._subscribers += [
                session.liveliness().declare_subscriber(keys.alive(robot, "*"), self._take_token, history=True),
                session.declare_subscriber(keys.status(robot, "*"), self._take_status),
                session.declare_subscriber(keys.holder(robot), self._take_holder),
            ]

    def _close(self) -> None:
        self._subscribers.clear()
        if self._session is not None:
            close_session(self._session)
        with self._lock:
            for robot in self._robots.values():
                for service in robot.services.values():
                    service.is_alive = False  # the next session receives the tokens again

    def _records(self, key: str) -> tuple[RobotRecord, ServiceRecord, float] | None:
        """Return the sender's records and the time; None if it is not a robot's service. Needs the lock."""
        _, name, service, *_ = key.split("/")  # zenoh delivers only keys `gemuco/<robot>/<service>/...`
        now = self._clock.monotonic()
        is_odd = service not in keys.SERVICES or not ROBOT.match(name)
        if is_odd or (name not in self._robots and len(self._robots) >= MOST):
            self.strange += 1
            return None
        robot = self._robots.setdefault(name, RobotRecord(name, now))
        robot.active_at = now
        return robot, robot.service(service), now

    def _take_token(self, sample: zenoh.Sample) -> None:
        with self._lock:
            if records := self._records(str(sample.key_expr)):
                records[1].is_alive = sample.kind == zenoh.SampleKind.PUT

    def _take_status(self, sample: zenoh.Sample) -> None:
        if (status := self._decoded(sample, Status)) is None:
            return
        with self._lock:
            if records := self._records(str(sample.key_expr)):
                records[1].add(status, records[2])

    def _take_holder(self, sample: zenoh.Sample) -> None:
        if (holder := self._decoded(sample, Holder)) is None:
            return
        with self._lock:
            if (records := self._records(str(sample.key_expr))) and not records[0].holders.problem(holder):
                records[0].holder = (records[2], holder)

    def _decoded(self, sample: zenoh.Sample, record: type[M]) -> M | None:
        try:
            return received_message(sample, record)
        except MessageError:
            self.rejected += 1
            return None
