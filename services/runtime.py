"""Where the files of running services lie: their locks and their heartbeats. Imports nothing that takes long."""

import os
from pathlib import Path

from services.errors import ServiceError


def runtime_folder() -> Path:
    """This user's folder: `$XDG_RUNTIME_DIR/gemuco`, or one in the temporary directory.

    Raises:
        ServiceError: It cannot be made.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base:
        folder = Path(base) / "gemuco"
    else:
        import tempfile  # takes longer than all the rest of a health check

        folder = Path(tempfile.gettempdir()) / f"gemuco-{os.getuid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ServiceError(f"The folder for locks, '{folder}', cannot be made: {error.strerror}.") from None
    return folder


def services_here() -> list[tuple[str, str]]:
    """Robot and service of every service that this user runs on this machine, as far as their locks tell, sorted.

    Raises:
        ServiceError: There is no folder for them.
    """
    found = []
    for lock in runtime_folder().glob("*.lock"):
        robot, _, service = lock.stem.rpartition(".")
        if robot and _runs(lock):
            found.append((robot, service))
    return sorted(found)


def _runs(lock: Path) -> bool:
    """Whether the process that wrote its number into a lock's file is there; the file stays when it ends.

    The lock itself is not tried: whoever holds it for a moment would keep the service from starting.
    """
    try:
        return Path(f"/proc/{int(lock.read_text())}").exists()
    except (OSError, ValueError):
        return False
