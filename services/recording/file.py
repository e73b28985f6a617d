"""File of a recording: MCAP of which every written part is whole, whatever happens next.

Added messages wait in memory and are written by `commit`, all or none: on a full disk, or at a limit on the size of
files, the file is cut back to its former size, so readers never see half a record.
"""

import json
import os
import re
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mcap
from mcap.writer import CompressionType, Writer

from services.errors import RecordingError

LIBRARY = f"gemuco; mcap {mcap.__version__}"
PROFILE = "gemuco"
CHUNK = 1 << 20
"""At most this many bytes of messages are compressed together; `commit` may come earlier."""
DIGITS = 6


class RecordingFile:
    """An MCAP file being written.

    Args:
        path: The file; it must not exist.

    Raises:
        RecordingError: The file exists, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._has_messages, self._is_empty = False, True
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, int], int] = {}
        self._stream = _CommittedStream(path)
        self._writer = Writer(self._stream, chunk_size=CHUNK, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._writer.start(profile=PROFILE, library=LIBRARY)

    @property
    def size(self) -> int:
        """Size on disk [bytes]."""
        return self._stream.written

    def channel(self, topic: str, encoding: str, name: str = "", schema: Mapping[str, Any] | None = None) -> int:
        """Return the channel for messages of an encoding and schema on a topic; it is made at the first call."""
        number = 0
        if schema is not None:
            data = json.dumps(schema, ensure_ascii=False).encode()
            definition = (name, "jsonschema", data)
            if definition not in self._schemas:
                self._schemas[definition] = self._writer.register_schema(*definition)
            number = self._schemas[definition]
        key = (topic, encoding, number)
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(topic, encoding, number)
        return self._channels[key]

    def add(self, channel: int, received_ns: int, stamp_ns: int, seq: int, data: bytes) -> None:
        """Add a message; it is safe after the next `commit`."""
        self._writer.add_message(channel, received_ns, data, stamp_ns, seq & 0xFFFFFFFF)
        self._has_messages = True

    def add_facts(self, name: str, facts: Mapping[str, str]) -> None:
        """Add facts about the whole recording, as MCAP metadata."""
        self._writer.add_metadata(name, dict(facts))

    def commit(self) -> None:
        """Write the waiting messages and ask the disk to keep them.

        Raises:
            OSError: They could not be written; the file stays as it was after the last commit.
        """
        self._writer.flush()
        self._commit()

    def finish(self) -> None:
        """Write the waiting messages and the index, and close.

        Raises:
            OSError: As `commit`; the file is closed, and has no index.
        """
        try:
            self._writer.finish()
            self._commit()
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close after a `commit` that failed; a file without a message is removed."""
        self._stream.close()
        if self._is_empty:
            self.path.unlink(missing_ok=True)

    def _commit(self) -> None:
        self._stream.commit()
        self._is_empty = not self._has_messages


class _CommittedStream:
    """Stream for mcap's writer: bytes wait until `commit`, which writes all of them or none."""

    def __init__(self, path: Path) -> None:
        self.written = 0
        self._waiting = bytearray()
        self._failure: OSError | None = None
        self._requested, self._ending = threading.Event(), False
        if path.exists():
            raise RecordingError(f"There is a file '{path}' already; a recording never replaces one.")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise RecordingError(f"The recording '{path}' cannot be written: {error.strerror}.") from None
        self._syncing = threading.Thread(target=self._sync, name="sync", daemon=True)
        self._syncing.start()

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self.written + len(self._waiting)

    def flush(self) -> None:
        """Do nothing; mcap's writer calls this, and `commit` comes after it."""

    def commit(self) -> None:
        if self._failure is not None:
            raise self._failure
        try:
            written = 0
            with memoryview(self._waiting) as view:
                while written < len(view):
                    written += os.write(self._file, view[written:])
        except OSError:
            os.ftruncate(self._file, self.written)
            raise
        self.written += len(self._waiting)
        self._waiting.clear()
        self._requested.set()

    def close(self) -> None:
        if self._file >= 0:
            self._ending = True
            self._requested.set()
            self._syncing.join()
            os.close(self._file)
            self._file = -1

    def _sync(self) -> None:
        """Ask the disk to keep what was written; this may take long, and writing goes on meanwhile."""
        while True:
            self._requested.wait()
            self._requested.clear()
            is_last = self._ending
            try:
                os.fdatasync(self._file)
            except OSError as error:
                self._failure = error
            if is_last:
                return


def next_path(path: Path, is_one_of_many: bool) -> Path:
    """Return the next file of a recording: the path itself, or a numbered one if there may be many or it exists.

    The seventh file of `walk.mcap` is `walk-000007.mcap`, so that names sort in the order of writing. Numbers continue
    from the highest existing one, so a killed recorder can be started again with the same arguments.
    """
    if not is_one_of_many and not path.exists():
        return path
    shape = re.compile(re.escape(path.stem) + rf"-(\d{{{DIGITS},}})" + re.escape(path.suffix))
    numbers = [int(match[1]) for other in path.parent.glob("*") if (match := shape.fullmatch(other.name))]
    least = 0 if is_one_of_many else 1  # the path itself is the first
    number = max(numbers, default=least) + 1
    return path.with_name(f"{path.stem}-{number:0{DIGITS}d}{path.suffix}")
