"""Sessions of a security check: router, HAL and model from their role files, and the sessions that attack them."""

import copy
import json
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh

from services.errors import ServiceError
from services.process.doors import door_settings
from services.process.router import router_settings
from services.security.plan import InstallationPlan
from services.security.role_files import EMERGENCY_PORT, person_ports
from services.wire import keys
from services.wire.connect import host_and_port, merge, role_file, with_password_file
from services.wire.member import DOORS, EMERGENCY, doors_in
from services.wire.roles import ROUTER

Weaken = Callable[[str, dict[str, Any]], None]
"""A function of this type takes a member's name and configuration, and weakens the configuration."""
PAYLOAD = b"gemuco security check"
"""This payload is not a valid message for any receiver."""
WITHIN = 15.0
"""A permitted exchange must succeed within this time [s], also on a busy machine."""
PATIENT = {"unicast": {"open_timeout": 5000, "accept_timeout": 5000}, "link": {"tx": {"lease": 10000}}}
"""These limits for links are long, because the check does not measure how soon a frozen process is detected."""
PAUSE = 0.02
ONCE = {"endpoints": [], "timeout_ms": 0, "exit_on_failure": True}
"""With these settings a session makes one attempt to connect."""


class Listener:
    """Messages that arrive at a session on some keys."""

    def __init__(self, session: zenoh.Session, *patterns: str) -> None:
        self._lock = threading.Lock()
        self._messages: list[tuple[str, bytes]] = []
        self._subscribers = [session.declare_subscriber(pattern, self._receive) for pattern in patterns]

    def _receive(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self._messages.append((str(sample.key_expr), sample.payload.to_bytes()))

    @property
    def anything(self) -> bool:
        """Whether any message arrived."""
        with self._lock:
            return bool(self._messages)

    def count(self, payload: bytes, key: str = "") -> int:
        """Return how often a payload arrived, on one key or on all keys."""
        with self._lock:
            return sum(data == payload and (not key or topic == key) for topic, data in self._messages)


class CheckSessions:
    """The sessions of one check, as a context manager.

    Args:
        folder: Folder of `gemuco security init`.
        running: Endpoint of a running router; None starts a router.
        weaken: Function that weakens configurations, for tests of the check.

    Attributes:
        robot: Name of the attacked robot.
        router: Endpoint of the router, for services.
        doors: Endpoints of the router for each person and for emergency stops, by name.
        hal: Endpoint of the HAL; empty if the check starts no HAL.
    """

    def __init__(self, folder: Path, running: str | None = None, weaken: Weaken | None = None) -> None:
        plan = InstallationPlan.read(folder)
        if plan is None or not plan.robots:
            raise ServiceError(f"'{folder}' was not made by `gemuco security init`: it has no plan.json with a robot.")
        self.plan, self.folder, self.robot = plan, folder, next(iter(plan.robots))
        self._weaken = weaken or (lambda name, configured: None)
        self._sessions: list[zenoh.Session] = []
        self._entities: list[Any] = []
        self.is_running = running is not None
        self.router = running or self.another_endpoint()
        self.doors = {
            name: self._running_door(offset) if running else self.another_endpoint()
            for name, offset in {EMERGENCY: EMERGENCY_PORT, **person_ports(plan)}.items()
        }
        self.hal = "" if running else self.another_endpoint()

    def __enter__(self) -> Self:
        try:
            if not self.is_running:
                self._start()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        closing = [threading.Thread(target=session.close, daemon=True) for session in self._sessions]
        for thread in closing:
            thread.start()
        for thread in closing:
            thread.join(2.0)

    def _start(self) -> None:
        router = self.of(ROUTER)
        router["listen"]["endpoints"] = [self.router]
        for name, door in doors_in(router).items():
            door["listen"] = self.doors[name]
        router = merge(router_settings(), router)
        for name, configured in {ROUTER: router, **door_settings(router)}.items():
            self._weaken(ROUTER if name == ROUTER else DOORS, configured)
            self.open(configured)
        hal, model = (self.of(f"{service}.{self.robot}") for service in ("hal", "model"))
        hal["listen"]["endpoints"], model["listen"]["endpoints"] = [self.hal], []
        hal["connect"]["endpoints"], model["connect"]["endpoints"] = [self.router], [self.hal, self.router]
        self._weaken("hal", hal)
        self.hal_session, self.model_session = self.open(hal), self.open(model)
        for session, service in ((self.hal_session, "hal"), (self.model_session, "model")):
            self._entities += [
                answer(session, self.key(service, "do", "describe"), b"true"),
                session.liveliness().declare_token(self.key(service, "alive")),
            ]

    def _running_door(self, offset: int) -> str:
        host, port = host_and_port(self.router.partition("/")[2])
        return f"{self.plan.protocol}/{host}:{int(port) + offset}"

    def door_of(self, name: str) -> str:
        """Return the endpoint of the router for a member."""
        return self.doors.get(name, self.router)

    def another_endpoint(self) -> str:
        """Return a free endpoint of this machine."""
        return f"{self.plan.protocol}/127.0.0.1:{_free_port()}"

    def of(self, name: str) -> dict[str, Any]:
        """Return a fresh copy of a member's role file."""
        path = self.folder / f"{name}.json"
        return copy.deepcopy(role_file(path))

    def weakened(self, name: str, called: str) -> dict[str, Any]:
        """Return a fresh copy of a member's role file; a test of the check may have weakened it."""
        configured = self.of(name)
        self._weaken(called, configured)
        return configured

    def outside(self, name: str, where: str = "") -> dict[str, Any]:
        """Return a member's role file as an attacker uses it: for a client of the router or `where`, without rules."""
        copied = self.of(name)
        for part in ("access_control", "downsampling", "low_pass_filter", "listen"):
            copied.pop(part, None)
        copied["transport"]["auth"]["usrpwd"].pop("dictionary", None)
        copied |= {"mode": "client", "connect": ONCE | {"endpoints": [where or self.door_of(name)]}}
        return copied

    def open(self, configuration: dict[str, Any]) -> zenoh.Session:
        """Open a session that is closed at the end of the check.

        Raises:
            zenoh.ZError: The session is refused.
        """
        with with_password_file(merge(configuration, {"transport": PATIENT})) as taken:
            session = zenoh.open(zenoh.Config.from_json5(json.dumps(taken)))
        self._sessions.append(session)
        return session

    @property
    def last(self) -> zenoh.Session:
        """The session that was opened last."""
        return self._sessions[-1]

    def enters(self, configuration: dict[str, Any]) -> bool:
        """Whether a session opens."""
        try:
            self.open(configuration)
        except zenoh.ZError:
            return False
        return True

    def member(self, name: str, where: str = "") -> zenoh.Session:
        """Open a session of a member at the router.

        Raises:
            ServiceError: The member is refused although its role file is valid.
        """
        configured = self.outside(name, where)
        configured["connect"] |= {"timeout_ms": round(1e3 * WITHIN)}
        try:
            return self.open(configured)
        except zenoh.ZError:
            raise ServiceError(
                f"'{name}' is refused at {where or self.door_of(name)} with its own role file, so the check is "
                "impossible."
            ) from None

    def key(self, *parts: str) -> str:
        """Return a key of the attacked robot."""
        return keys.robot_key(self.robot, *parts)


def until(condition: Callable[[], object], within: float = WITHIN) -> bool:
    """Whether a condition becomes true within a time [s]."""
    deadline = time.monotonic() + within
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(PAUSE)
    return False


def answer(session: zenoh.Session, key: str, payload: bytes) -> zenoh.Queryable:
    """Declare a queryable that always answers with the same payload."""

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, payload)

    return session.declare_queryable(key, reply)


def answered(session: zenoh.Session, selector: str, payload: bytes = b"true", timeout: float = 2.0) -> bool:
    """Whether any answer to a query has this payload."""
    replies = session.get(selector, target=zenoh.QueryTarget.ALL, timeout=timeout)
    return any(reply.ok is not None and reply.ok.payload.to_bytes() == payload for reply in replies)


def _free_port() -> int:
    """Return a port of this machine that is free for TCP and for UDP."""
    while True:
        with socket.socket(type=socket.SOCK_DGRAM) as datagrams, socket.socket() as stream:
            datagrams.bind(("127.0.0.1", 0))
            try:
                stream.bind(datagrams.getsockname())
            except OSError:
                continue  # another program has it for TCP
            return int(datagrams.getsockname()[1])
