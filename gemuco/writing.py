"""Files that are written whole or not at all, and a sentence when they cannot be."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safetensors import SafetensorError

from gemuco.errors import NotWritten


@contextmanager
def writing(what: str, path: Path) -> Iterator[None]:
    """Make what the file system refuses inside one sentence.

    Args:
        what: Begins the sentence, such as `The model`.
        path: Where it was to be.

    Raises:
        NotWritten: The disk is full, the place is read-only, a folder is a file, ...
    """
    try:
        yield
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise NotWritten(
            f"{what} cannot be written to '{path}': {reason}. Make room or get leave to write there, or name another "
            "place."
        ) from None
