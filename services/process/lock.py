"""One service of a kind per robot: a file lock on this machine, a liveliness token on the network."""

import contextlib
import fcntl
import logging
import os
from collections.abc import Iterable, Iterator
from typing import TextIO

import zenoh

from services.errors import AlreadyRunning, NoAnswer, ServiceError
from services.runtime import runtime_folder
from services.wire import keys, query
from services.wire.session import address, close_session, open_with, settings

log = logging.getLogger(__name__)

ROUTER_WITHIN_MS = 500
"""How long a router may take to let in who looks; one that is not there must not keep a HAL from starting."""


class ServiceLock:
    """Held for as long as a service of a robot runs; the kernel frees it even after kill -9.

    Args:
        robot: The robot's name.
        service: One of `keys.SERVICES`.
    """

    def __init__(self, robot: str, service: str) -> None:
        self.robot, self.service = robot, service
        self._file: TextIO | None = None

    def acquire(self) -> None:
        """Take the lock.

        Raises:
            AlreadyRunning: Another process of this machine holds it; the message names its pid.
        """
        path = runtime_folder() / f"{self.robot}.{self.service}.lock"
        file = path.open("a+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            holder = file.read().strip()
            file.close()
            raise AlreadyRunning(self._sentence(f"process {holder or 'unknown'} on this machine")) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        self._file = file

    def check_network(self, session: zenoh.Session) -> None:
        """Look for the same service elsewhere on the network. Call before declaring one's own token.

        Raises:
            AlreadyRunning: It is alive; the message names its host and pid as far as it tells them.
        """
        if self.service not in query.alive(session, self.robot):
            return
        try:
            who = query.ask(session, keys.verb(self.robot, self.service, "describe"), timeout=0.5)
        except ServiceError:
            who = {}
        raise AlreadyRunning(
            self._sentence(f"process {who.get('pid', 'unknown')} on {who.get('host', 'another host')}")
        )

    def check_router(self, connect: Iterable[str]) -> None:
        """Look for the same service of another machine that shares a router with this one. Call before opening.

        Services are peers, and a router does not show peers to each other; a client of it sees them all. A token
        without anybody who answers is that of a process that has just died.

        Args:
            connect: Endpoints and role files.

        Raises:
            AlreadyRunning: It is alive, and tells its host and pid.
        """
        told = tuple(connect)
        if not told:
            return
        found = settings(self.robot, self.service, told)
        own = f"tcp/{address(self.robot)}:"
        places = [one for one in found["connect"]["endpoints"] if not one.startswith(own)]
        found |= {"mode": "client", "listen": {"endpoints": [], "exit_on_failure": True}}
        found["connect"] |= {"endpoints": places, "timeout_ms": ROUTER_WITHIN_MS, "exit_on_failure": True}
        try:
            session = open_with(found, f"a look for other '{self.service}' services of robot '{self.robot}'")
        except ServiceError as error:
            log.info("Nobody could be asked whether robot '%s' is unique: %s", self.robot, error)
            return
        try:
            if self.service in query.alive(session, self.robot):
                who = query.ask(session, keys.verb(self.robot, self.service, "describe"), timeout=0.5)
                raise AlreadyRunning(self._sentence(f"process {who.get('pid')} on {who.get('host')}"))
        except NoAnswer as error:
            log.info("A token of robot '%s' is there, and nobody with it: %s", self.robot, error)
        finally:
            close_session(session)

    def release(self) -> None:
        """Give the lock back. Safe to call twice."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _sentence(self, holder: str) -> str:
        return f"Robot '{self.robot}' already has a '{self.service}' service: {holder}. Stop that one first."


@contextlib.contextmanager
def instead_of(robot: str, service: str) -> Iterator[None]:
    """Do what a service would do: it must not run on this machine, and cannot start, for as long as the context lasts.

    Raises:
        AlreadyRunning: It runs.
    """
    lock = ServiceLock(robot, service)
    lock.acquire()
    try:
        yield
    finally:
        lock.release()
