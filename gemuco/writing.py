"""Files that are replaced in one step, and the error message for files that cannot be written."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from safetensors import SafetensorError

from gemuco.errors import NotWritten

PART = ".part"
"""A file that is being written has its later name with this suffix."""


@contextmanager
def writing(what: str, path: Path) -> Iterator[None]:
    """Replace an error of the file system by one with a clear message.

    Args:
        what: First words of the message, such as `The model`.
        path: The file or folder.

    Raises:
        NotWritten: The disk is full, the folder is read-only, a file has the name of the folder, ...
    """
    try:
        yield
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise NotWritten(
            f"{what} cannot be written to '{path}': {reason}. Make room, get permission, or name another place."
        ) from None


@contextmanager
def replacing(path: Path, mode: int | None = None) -> Iterator[BinaryIO]:
    """Yield a file that takes the place of `path` in one step, on the disk, when the context ends without an error.

    A process that is killed meanwhile, and a power failure, leave the former file whole. Writers of the same path wait
    for each other.

    Args:
        path: The file; its folder is made if it is missing.
        mode: Permissions of the new file from its first byte on; None for those of any new file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + PART)
    with _own(part, mode) as file:
        try:
            yield file
            file.flush()
            os.fsync(file.fileno())
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def replace(path: Path, data: bytes) -> None:
    """Write a file as `replacing` does."""
    with replacing(path) as file:
        file.write(data)


def sync_folder(folder: Path) -> None:
    """Wait until the names of a folder are on the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _own(part: Path, mode: int | None) -> BinaryIO:
    """Open and lock the empty part; one that a killed process left is used again, and a link is not followed."""
    while True:
        handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666 if mode is None else mode)
        file = os.fdopen(handle, "wb")
        fcntl.flock(handle, fcntl.LOCK_EX)
        try:
            is_ours = os.path.samestat(os.fstat(handle), part.lstat())
        except FileNotFoundError:  # the process that had the lock has put it in its place
            is_ours = False
        if is_ours:
            os.ftruncate(handle, 0)
            if mode is not None:
                os.fchmod(handle, mode)
            return file
        file.close()
