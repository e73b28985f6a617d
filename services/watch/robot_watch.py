"""Snapshots of one robot: of a client that is open, or of one that opens by itself and opens again."""

import logging
import threading
from collections.abc import Iterable
from typing import Any, TypeVar

from hal.clock import Clock, SystemClock
from services.client import Client
from services.client.live import FRESH_STATUS
from services.errors import ServiceError
from services.watch.snapshot import Newest, RobotSnapshot, held
from services.wire import keys
from services.wire.caller import own_name
from services.wire.messages import Anomaly, Applied, Estimates, Holder, Message, Sample, Status, Update

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)

EVERY = 0.5
"""The live services are looked up at this interval [s]."""


def snapshot_of(client: Client, alive: Iterable[str], clock: Clock | None = None, **more: Any) -> RobotSnapshot:
    """Return all newest messages of a client's robot; the first call subscribes to them.

    Args:
        client: An open client.
        alive: Names of the live services.
        clock: Clock of the ages.
        more: Further attributes of the snapshot.
    """
    now, refused, disordered = (clock or SystemClock()).monotonic(), dict[str, None](), dict[str, None]()

    def newest(key: str, record: type[M]) -> Newest[M] | None:
        reader = client.reader(key, record)
        last = reader.last()
        if text := reader.other_version(FRESH_STATUS):
            refused[text] = None
        if text := reader.disorder(FRESH_STATUS):
            disordered[text] = None
        return None if last is None else Newest(last.message, max(0.0, now - last.received))

    robot = client.robot
    statuses = {name: newest(keys.status(robot, name), Status) for name in keys.SERVICES}
    snapshot = RobotSnapshot(
        robot=robot,
        alive=frozenset(alive),
        sample=newest(keys.sample(robot), Sample),
        vision=newest(keys.vision(robot), Sample),
        applied=newest(keys.applied(robot), Applied),
        estimate=newest(keys.estimate(robot), Estimates),
        anomaly=newest(keys.anomaly(robot), Anomaly),
        update=newest(keys.update(robot), Update),
        holder=newest(keys.holder(robot), Holder),
        statuses={name: status for name, status in statuses.items() if status is not None},
        refused=tuple(refused),
        disordered=tuple(disordered),
        **more,
    )
    return held(snapshot)


class Descriptions:
    """Answers of the HAL's and the model's `describe`, queried once per run of each service."""

    def __init__(self) -> None:
        self._boots: dict[str, int] = {}
        self.answers: dict[str, dict[str, Any]] = {"hal": {}, "model": {}}
        """Service -> its answer; empty before."""

    def update(self, client: Client, alive: Iterable[str]) -> None:
        """Query the live services that were started since the last call.

        Raises:
            ServiceError: A service does not answer.
        """
        for service in self.answers.keys() & set(alive):
            last = client.reader(keys.status(client.robot, service), Status).last()
            if last is not None and last.message.boot != self._boots.get(service):
                self.answers[service] = client.describe(service)
                self._boots[service] = last.message.boot


class RobotWatch:
    """A thread that keeps a client of one robot open; `look` never waits.

    Args:
        robot: Name of the robot.
        connect: Endpoints, such as a router's, and role files.
        clock: Clock of the ages.
    """

    def __init__(self, robot: str, connect: Iterable[str] = (), clock: Clock | None = None) -> None:
        self.robot = robot
        self._connect = tuple(connect)
        self._clock = clock or SystemClock()
        self._client: Client | None = None
        self._alive: frozenset[str] = frozenset()
        self._linked, self._link_text = not self._connect, ""
        self._descriptions = Descriptions()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        """Start the thread; services may start later."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the client."""
        self._stop.set()
        self._thread.join(5.0)

    @property
    def client(self) -> Client | None:
        """The open client; None if there is none."""
        return self._client

    def look(self) -> RobotSnapshot:
        """Return everything that is known of the robot now."""
        client = self._client
        if client is None:
            return RobotSnapshot(robot=self.robot, linked=self._linked, link_text=self._link_text)
        return snapshot_of(
            client,
            self._alive,
            self._clock,
            linked=self._linked,
            link_text=self._link_text,
            **self._descriptions.answers,
        )

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._turn()
            except ServiceError as error:
                self._link_text = str(error)
            except Exception:
                log.exception("Watching '%s' failed", self.robot)
            self._stop.wait(EVERY)
        if self._client is not None:
            self._client.__exit__(None, None, None)

    def _turn(self) -> None:
        if self._client is None:
            client = Client(self.robot, self._connect, f"view, {own_name()}")
            client.__enter__()
            self._client = client
            self.look()  # subscribes
        client = self._client
        info = client.session.info
        self._linked = not self._connect or bool(list(info.routers_zid()) or list(info.peers_zid()))
        if not self._linked:
            where = ", ".join(self._connect)
            self._alive = frozenset()
            self._link_text = f"No answer from {where}. Is `gemuco router` running? The page continues by itself."
            return
        self._alive = frozenset(client.alive())
        self._descriptions.update(client, self._alive)
