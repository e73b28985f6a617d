"""One service of a kind per robot: a file lock on this machine, a liveliness token on the network."""

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import zenoh

from services import keys, query
from services.errors import AlreadyRunning, ServiceError


def runtime_folder() -> Path:
    """Where this user's locks lie: `$XDG_RUNTIME_DIR/gemuco`, or a folder in the temporary directory."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(base) / "gemuco" if base else Path(tempfile.gettempdir()) / f"gemuco-{os.getuid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ServiceError(f"The folder for locks, '{folder}', cannot be made: {error.strerror}.") from None
    return folder


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
