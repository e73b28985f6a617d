"""One file of a recording: MCAP whose every written part is whole, whatever happens next.

What is added waits in memory and is written by `commit`, all of it or nothing: where the disk is full, or a limit on
the size of files is met, the file is cut back to what it was, so that readers never find half a record.
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
"""Bytes of messages that are compressed together, if `commit` does not come first."""
DIGITS = 6


class RecordingFile:
    """An MCAP file being written.

    Args:
        path: Must not exist.

    Raises:
        RecordingError: It exists, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.messages = 0
        """Messages that are safe in the file."""
        self._pending = 0
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, int], int] = {}
        self._stream = _Whole(path)
        self._writer = Writer(self._stream, chunk_size=CHUNK, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._writer.start(profile=PROFILE, library=LIBRARY)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return self._stream.written

    def channel(self, topic: str, encoding: str, name: str = "", schema: Mapping[str, Any] | None = None) -> int:
        """The channel for messages of this encoding and schema on a topic, made when first asked for."""
        number = 0
        if schema is not None:
            data = json.dumps(schema, ensure_ascii=False).encode()
            which = (name, "jsonschema", data)
            if which not in self._schemas:
                self._schemas[which] = self._writer.register_schema(*which)
            number = self._schemas[which]
        key = (topic, encoding, number)
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(topic, encoding, number)
        return self._channels[key]

    def add(self, channel: int, received_ns: int, stamp_ns: int, seq: int, data: bytes) -> None:
        """Add a message; it is safe after the next `commit`."""
        self._writer.add_message(channel, received_ns, data, stamp_ns, seq & 0xFFFFFFFF)
        self._pending += 1

    def tell(self, name: str, facts: Mapping[str, str]) -> None:
        """Add facts of the whole recording, as MCAP metadata."""
        self._writer.add_metadata(name, dict(facts))

    def commit(self) -> None:
        """Write what waits and have the disk keep it.

        Raises:
            OSError: It could not be written; the file is as it was after the last commit, and stays so.
        """
        self._writer.flush()
        self._stream.commit()
        self.messages += self._pending
        self._pending = 0

    def finish(self) -> None:
        """Write what waits and the index, and close.

        Raises:
            OSError: As `commit`; the file is closed, and has no index.
        """
        try:
            self._writer.finish()
            self._stream.commit()
            self.messages += self._pending
            self._pending = 0
        finally:
            self._stream.close()

    def abandon(self) -> int:
        """Close after a `commit` that failed; a file without a message is removed.

        Returns:
            How many messages were not written.
        """
        self._stream.close()
        if self.messages == 0:
            self.path.unlink(missing_ok=True)
        return self._pending


class _Whole:
    """What mcap's writer writes to: bytes that wait until `commit`, which writes all of them or none."""

    def __init__(self, path: Path) -> None:
        self.written = 0
        self._waiting = bytearray()
        self._failure: OSError | None = None
        self._wanted, self._ending = threading.Event(), False
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
        """Mcap's writer calls this; `commit` comes after it."""

    def commit(self) -> None:
        if self._failure is not None:
            raise self._failure
        try:
            done = 0
            with memoryview(self._waiting) as view:
                while done < len(view):
                    done += os.write(self._file, view[done:])
        except OSError:
            os.ftruncate(self._file, self.written)
            raise
        self.written += len(self._waiting)
        self._waiting.clear()
        self._wanted.set()

    def close(self) -> None:
        if self._file >= 0:
            self._ending = True
            self._wanted.set()
            self._syncing.join()
            os.close(self._file)
            self._file = -1

    def _sync(self) -> None:
        """Have the disk keep what was written; it may take long, while what comes is written all the same."""
        while True:
            self._wanted.wait()
            self._wanted.clear()
            is_last = self._ending
            try:
                os.fdatasync(self._file)
            except OSError as error:
                self._failure = error
            if is_last:
                return


def numbered(path: Path, number: int) -> Path:
    """`walk.mcap` and 7 make `walk-000007.mcap`, so that names sort as the files were written."""
    return path.with_name(f"{path.stem}-{number:0{DIGITS}d}{path.suffix}")


def next_path(path: Path, is_one_of_many: bool) -> Path:
    """The next file of a recording: the path itself, or, where there may be many or it exists, a numbered one.

    Numbers go on from the highest that is there, so that a recorder that was killed can be started again as it was.
    """
    if not is_one_of_many and not path.exists():
        return path
    shape = re.compile(re.escape(path.stem) + rf"-(\d{{{DIGITS},}})" + re.escape(path.suffix))
    found = [int(match[1]) for one in _beside(path) if (match := shape.fullmatch(one.name))]
    least = 0 if is_one_of_many else 1  # the path itself is the first
    return numbered(path, max(found, default=least) + 1)


def _beside(path: Path) -> list[Path]:
    return list(path.parent.iterdir()) if path.parent.is_dir() else []
