"""One service of a kind per robot: a file lock on this machine, a liveliness token on the network."""

import contextlib
import fcntl
import logging
from collections.abc import Iterable, Iterator
from typing import IO

import zenoh

from services.errors import AlreadyRunning, NoAnswer, ServiceError
from services.runtime import open_file, own_line, runtime_folder
from services.wire import keys, query
from services.wire.session import address, close_session, open_with, settings

log = logging.getLogger(__name__)

ROUTER_WITHIN_MS = 500
"""A router must answer within this time; an absent one must not keep a HAL from starting."""


class ServiceLock:
    """The lock that a running service of a robot holds; the kernel releases it even after kill -9.

    Args:
        robot: The robot's name.
        service: One of `keys.SERVICES`.
    """

    def __init__(self, robot: str, service: str) -> None:
        self.robot, self.service = robot, service
        self._file: IO[str] | None = None

    def acquire(self) -> None:
        """Take the lock.

        Raises:
            AlreadyRunning: Another process of this machine holds it; the message names its pid.
            ServiceError: It is a link, or other users could exchange it.
        """
        path = runtime_folder() / f"{self.robot}.{self.service}.lock"
        try:
            file = open(path, "a+", opener=open_file)  # noqa: SIM115
        except OSError as error:
            raise ServiceError(f"The lock '{path}' cannot be opened: {error.strerror}. Remove it.") from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            holder = file.read().partition(" ")[0]
            file.close()
            raise AlreadyRunning(self._sentence(f"process {holder or 'unknown'} on this machine")) from None
        file.truncate(0)
        file.write(own_line())
        file.flush()
        self._file = file

    def check_network(self, session: zenoh.Session) -> None:
        """Look for the same service elsewhere on the network. Call before declaring one's own token.

        Raises:
            AlreadyRunning: It is alive; the message names its host and pid if it answers.
        """
        if self.service not in query.alive(session, self.robot):
            return
        try:
            other = self._describe_other(session)
        except ServiceError:
            other = "process unknown on another host"
        raise AlreadyRunning(self._sentence(other))

    def check_router(self, connect: Iterable[str]) -> None:
        """Look for the same service of another machine that shares a router with this one. Call before opening.

        Services are peers, and a router does not show peers to each other; a client of it sees them all. A token
        without an answer belongs to a process that has just died.

        Args:
            connect: Endpoints and role files.

        Raises:
            AlreadyRunning: It is alive; the message names its host and pid.
        """
        items = tuple(connect)
        if not items:
            return
        configuration = settings(self.robot, self.service, items)
        own = f"tcp/{address(self.robot)}:"
        places = [place for place in configuration["connect"]["endpoints"] if not place.startswith(own)]
        configuration |= {"mode": "client", "listen": {"endpoints": [], "exit_on_failure": True}}
        configuration["connect"] |= {"endpoints": places, "timeout_ms": ROUTER_WITHIN_MS, "exit_on_failure": True}
        try:
            session = open_with(configuration, f"a look for other '{self.service}' services of robot '{self.robot}'")
        except ServiceError as error:
            log.info("No router could be asked whether robot '%s' is unique: %s", self.robot, error)
            return
        try:
            if self.service in query.alive(session, self.robot):
                raise AlreadyRunning(self._sentence(self._describe_other(session)))
        except NoAnswer as error:
            log.info("A token of robot '%s' exists, but no service answers: %s", self.robot, error)
        finally:
            close_session(session)

    def release(self) -> None:
        """Release the lock. Safe to call twice."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _describe_other(self, session: zenoh.Session) -> str:
        answer = query.ask(session, keys.verb(self.robot, self.service, "describe"), timeout=0.5)
        return f"process {answer.get('pid', 'unknown')} on {answer.get('host', 'another host')}"

    def _sentence(self, holder: str) -> str:
        return f"Robot '{self.robot}' already has a '{self.service}' service: {holder}. Stop that one first."


@contextlib.contextmanager
def instead_of(robot: str, service: str) -> Iterator[None]:
    """Take the place of a service, which cannot start on this machine while the context lasts.

    Raises:
        AlreadyRunning: The service runs.
    """
    lock = ServiceLock(robot, service)
    lock.acquire()
    try:
        yield
    finally:
        lock.release()
