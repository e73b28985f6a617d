"""The folder of running services' files, which are locks and heartbeats. It imports nothing that takes long."""

import os
from pathlib import Path

from hal.own_folder import NotOwnFolder, own_folder
from services.errors import ServiceError


def runtime_folder() -> Path:
    """Make and return this user's folder, as `own_folder` does.

    Raises:
        ServiceError: It cannot be made, or other users could exchange files in it.
    """
    try:
        return own_folder()
    except NotOwnFolder as error:
        raise ServiceError(f"The folder for locks is not safe: {error}") from None
    except OSError as error:
        raise ServiceError(f"The folder for locks, '{error.filename}', cannot be made: {error.strerror}.") from None


def open_file(path: str, flags: int) -> int:
    """Open a file of the runtime folder for this user alone, and follow no link; an `opener` of `open`."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)


def services_here() -> list[tuple[str, str]]:
    """Return (robot, service) of every service that this user runs on this machine, sorted.

    Raises:
        ServiceError: The folder of their locks cannot be made.
    """
    names = [(lock.stem.rpartition("."), lock) for lock in runtime_folder().glob("*.lock")]
    return sorted((robot, service) for (robot, _, service), lock in names if robot and _runs(lock))


def own_line() -> str:
    """Return what the lock of this process says: its pid and when it started."""
    return f"{os.getpid()} {_started(os.getpid())}"


def _runs(lock: Path) -> bool:
    """Whether the process that a lock's file names still runs; the file remains after its end.

    The lock itself is not tried: a process that starts at that moment would be refused.
    """
    try:
        pid, started = lock.read_text().split()
        return _started(int(pid)) == started
    except (OSError, ValueError):
        return False


def _started(pid: int) -> str:
    """Return when a process started [clock ticks since boot]: its pid may be another process's later.

    Raises:
        OSError: There is no such process.
    """
    after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]  # a name may contain anything
    return after_name.split()[19]
