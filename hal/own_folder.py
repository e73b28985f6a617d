"""The folder of this user's running programs: locks, heartbeats and sockets, which no other user can change."""

import os
import stat
from pathlib import Path

from hal.errors import HalError


class NotOwnFolder(HalError):
    """A folder that another user owns, can write to, or has made a link to somewhere else."""


def own_folder() -> Path:
    """Make and return `$XDG_RUNTIME_DIR/gemuco`, or `gemuco-UID` in the temporary directory, with mode 700.

    Any user of the machine can make a folder or a link of this name first, so owner, mode and kind are checked.

    Raises:
        NotOwnFolder: Another user could exchange files in it.
        OSError: It cannot be made.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base:
        folder = Path(base) / "gemuco"
    else:
        import tempfile  # this import takes longer than the rest of a health check

        folder = Path(tempfile.gettempdir()) / f"gemuco-{os.geteuid()}"
    folder.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    above = folder.parent.stat()
    if above.st_uid not in (0, os.geteuid()):
        raise NotOwnFolder(_sentence(folder.parent, f"belongs to user {above.st_uid}"))
    if above.st_mode & 0o022 and not above.st_mode & stat.S_ISVTX:
        raise NotOwnFolder(_sentence(folder.parent, "can be written to by other users"))
    folder.mkdir(exist_ok=True, mode=0o700)
    check_own(folder)
    return folder


def check_own(folder: Path) -> None:
    """Check that an existing folder is this user's, and hide it from other users.

    Raises:
        NotOwnFolder: Another user owns it or can write to it, or it is a link.
        OSError: It does not exist.
    """
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode):
        raise NotOwnFolder(_sentence(folder, "is a link or a file"))
    if status.st_uid != os.geteuid():
        raise NotOwnFolder(_sentence(folder, f"belongs to user {status.st_uid}"))
    if status.st_mode & 0o022:
        raise NotOwnFolder(_sentence(folder, "can be written to by other users"))
    if status.st_mode & 0o077:
        folder.chmod(0o700)


def _sentence(folder: Path, fault: str) -> str:
    return (
        f"'{folder}' {fault}, and this is user {os.geteuid()}: files in it could be exchanged. Find out who made it, "
        "remove it, or set XDG_RUNTIME_DIR to a folder of your own."
    )
