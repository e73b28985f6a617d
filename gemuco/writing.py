"""Error message for files that cannot be written."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safetensors import SafetensorError

from gemuco.errors import NotWritten


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
