"""The folder of running services' files, which are locks and heartbeats. It imports nothing that takes long."""

import os
from pathlib import Path

from services.errors import ServiceError


def runtime_folder() -> Path:
    """Make and return this user's folder: `$XDG_RUNTIME_DIR/gemuco`, or one in the temporary directory.

    Raises:
        ServiceError: It cannot be made.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base:
        folder = Path(base) / "gemuco"
    else:
        import tempfile  # this import takes longer than the rest of a health check

        folder = Path(tempfile.gettempdir()) / f"gemuco-{os.getuid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ServiceError(f"The folder for locks, '{folder}', cannot be made: {error.strerror}.") from None
    return folder


def services_here() -> list[tuple[str, str]]:
    """Return (robot, service) of every service that this user runs on this machine, sorted.

    Raises:
        ServiceError: The folder of their locks cannot be made.
    """
    names = [(lock.stem.rpartition("."), lock) for lock in runtime_folder().glob("*.lock")]
    return sorted((robot, service) for (robot, _, service), lock in names if robot and _runs(lock))


def _runs(lock: Path) -> bool:
    """Whether the process whose pid is in a lock's file exists; the file remains after its end.

    The lock itself is not tried: a process that starts at that moment would be refused.
    """
    try:
        return Path(f"/proc/{int(lock.read_text())}").exists()
    except (OSError, ValueError):
        return False
