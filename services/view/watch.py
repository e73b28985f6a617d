"""A client that opens by itself, opens again, and remembers the newest of everything."""

import logging
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from hal.clock import Clock, SystemClock
from services.client import Client
from services.errors import ServiceError
from services.view.seen import Heard, Seen
from services.wire import keys
from services.wire.caller import own_name
from services.wire.messages import Anomaly, Applied, Estimates, Holder, Message, Sample, Status, Update
from services.wire.streams import Reader

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)

EVERY = 0.5
"""Time [s] between looks at who is there."""
DESCRIBED = ("hal", "model")


@dataclass(slots=True)
class _Told:
    """What a service's `describe` said, and in which of its runs."""

    boot: int = 0
    about: Mapping[str, Any] = field(default_factory=dict)


class Watch:
    """Watches one robot from a thread of its own; `look` never waits.

    Args:
        robot: The robot's name.
        connect: Endpoints, such as a router's, and role files.
        clock: For the ages.
    """

    def __init__(self, robot: str, connect: Iterable[str] = (), clock: Clock | None = None) -> None:
        self.robot = robot
        self._connect = tuple(connect)
        self._clock = clock or SystemClock()
        self._client: Client | None = None
        self._alive: frozenset[str] = frozenset()
        self._linked, self._link_text = not self._connect, ""
        self._told = {name: _Told() for name in DESCRIBED}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        """Begin; whoever is not there yet is waited for."""
        self._thread.start()

    def stop(self) -> None:
        """End, and close the client."""
        self._stop.set()
        self._thread.join(5.0)

    @property
    def client(self) -> Client | None:
        """The open client; None while there is none."""
        return self._client

    def look(self) -> Seen:
        """Everything that was heard up to now."""
        client = self._client
        if client is None:
            return Seen(robot=self.robot, linked=self._linked, link_text=self._link_text)
        statuses = {name: self._heard(_status(client, name)) for name in keys.SERVICES}
        return Seen(
            robot=self.robot,
            linked=self._linked,
            link_text=self._link_text,
            alive=self._alive,
            sample=self._heard(client.reader(keys.sample(self.robot), Sample)),
            vision=self._heard(client.reader(keys.vision(self.robot), Sample)),
            applied=self._heard(client.reader(keys.applied(self.robot), Applied)),
            estimate=self._heard(client.reader(keys.estimate(self.robot), Estimates)),
            anomaly=self._heard(client.reader(keys.anomaly(self.robot), Anomaly)),
            update=self._heard(client.reader(keys.update(self.robot), Update)),
            holder=self._heard(client.reader(keys.holder(self.robot), Holder)),
            statuses={name: heard for name, heard in statuses.items() if heard is not None},
            hal=self._told["hal"].about,
            model=self._told["model"].about,
        )

    def _heard(self, reader: Reader[M]) -> Heard[M] | None:
        last = reader.last()
        return None if last is None else Heard(last.message, max(0.0, self._clock.monotonic() - last.received))

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
            self._link_text = f"Nobody at {where} answers. Is `gemuco router` running? This page goes on by itself."
            return
        self._alive = frozenset(client.alive())
        for service, told in self._told.items():
            last = _status(client, service).last()
            if service in self._alive and last is not None and last.message.boot != told.boot:
                about = client.describe(service)
                told.boot, told.about = last.message.boot, about


def _status(client: Client, service: str) -> Reader[Status]:
    return client.reader(keys.status(client.robot, service), Status)
