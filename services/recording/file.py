"""MCAP file of a recording, which stays readable after every failure.

Added messages wait in memory. `commit` writes all of them or none: if the disk is full or the file too large, the file
is cut back to its former size, so readers never see a part of a record.
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
"""At most this many bytes of messages are compressed together, or fewer at a `commit`."""
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
        """Return the channel for a topic, encoding and schema; the first call makes the channel."""
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
        """Write the waiting messages, and start to flush them to the disk.

        Raises:
            OSError: The write failed; the file stays as it was after the last commit.
        """
        self._writer.flush()
        self._commit()

    def finish(self) -> None:
        """Write the waiting messages and the index, and close.

        Raises:
            OSError: The write failed; the file is closed without an index.
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
    """Stream for the MCAP writer, with bytes that wait until `commit` writes all of them or none."""

    def __init__(self, path: Path) -> None:
        self.written = 0
        self._waiting = bytearray()
        self._failure: OSError | None = None
        self._requested, self._ending = threading.Event(), False
        if path.exists():
            raise RecordingError(f"The file '{path}' exists already; a recording never replaces a file.")
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
        """Do nothing: the MCAP writer calls this, and `commit` writes later."""

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
        """Flush written data to the disk; this may take long, and does not block writing."""
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
    """Return the next file of a recording: `path`, or a numbered file if there may be many files or `path` exists.

    The seventh file of `walk.mcap` is `walk-000007.mcap`, so that names sort in the order of writing. Numbers continue
    from the highest existing one, so a killed recorder can be started again with the same arguments.
    """
    if not is_one_of_many and not path.exists():
        return path
    pattern = re.compile(re.escape(path.stem) + rf"-(\d{{{DIGITS},}})" + re.escape(path.suffix))
    numbers = [int(match[1]) for other in path.parent.glob("*") if (match := pattern.fullmatch(other.name))]
    last = max(numbers, default=0 if is_one_of_many else 1)  # without limits `path` is the first file
    number = last + 1
    return path.with_name(f"{path.stem}-{number:0{DIGITS}d}{path.suffix}")
