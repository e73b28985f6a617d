"""The process that writes down all that a robot's services publish: MCAP, one channel per key, messages as they were.

Whatever was received more than a second ago survives kill -9. What was lost is counted and written into the file.
"""

import contextlib
import itertools
import logging
import queue
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self, TypeGuard

import mcap
import msgpack
import zenoh
from mcap.writer import CompressionType, Writer

from services import keys
from services.errors import RecordingError
from services.messages import Status
from services.service import Service, until_told

log = logging.getLogger(__name__)

QUEUE = 4096
"""Messages waiting to be written; at five streams of 200 Hz, four seconds of a disk that stalls."""
FLUSH_EVERY = 0.5
LIBRARY = f"gemuco; mcap {mcap.__version__}"
METADATA = "gemuco"
Item = tuple[str, int, bytes]
"""Key, time of arrival [ns since 1970], payload."""


class Recorder:
    """Records a robot's keys into one file, from entering to leaving.

    Args:
        session: An open session; it must outlive the recorder.
        robot: The robot's name.
        path: The file; an existing one is refused.
        depth: How many messages may wait to be written; more are dropped and counted.
    """

    def __init__(self, session: zenoh.Session, robot: str, path: Path, depth: int = QUEUE) -> None:
        self.path = path
        self.written = 0
        """Messages in the file."""
        self.dropped = 0
        """Messages that came while the queue was full."""
        self.missed = 0
        """Gaps in the senders' counting: messages that never came."""
        self.failure = ""
        """Why writing ended early; empty while all is well."""
        self._session = session
        self._robot = robot
        self._queue: queue.Queue[Item | None] = queue.Queue(depth)
        self._channels: dict[str, int] = {}
        self._last: dict[str, tuple[int, int]] = {}
        self._told: dict[str, str] = {}

    def __enter__(self) -> Self:
        if self.path.exists():
            raise RecordingError(f"There is a file '{self.path}' already; a recording never replaces one.")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = self.path.open("xb")
        except OSError as error:
            raise RecordingError(f"The recording '{self.path}' cannot be written: {error.strerror}.") from None
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile="gemuco", library=LIBRARY)
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()
        self._subscriber = self._session.declare_subscriber(keys.everything(self._robot), self._receive)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._subscriber.undeclare()
        self._queue.put(None)
        self._thread.join()
        self._file.close()

    def counters(self) -> dict[str, int | str]:
        """What was written, what was lost, and why writing ended early, if it did."""
        return {
            "path": str(self.path),
            "written": self.written,
            "dropped": self.dropped,
            "missed": self.missed,
            "waiting": self._queue.qsize(),
            "failure": self.failure,
        }

    def _receive(self, sample: zenoh.Sample) -> None:
        """In zenoh's thread: note the time, never wait."""
        item = (str(sample.key_expr), time.time_ns(), sample.payload.to_bytes())
        if self.failure:
            self.dropped += 1
            return
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self.dropped += 1

    def _write(self) -> None:
        try:
            self._write_until_told()
        except Exception as error:  # whatever it was, what comes from now on counts as dropped, and is told
            self.failure = f"The recording '{self.path}' ended early: {error}."
            log.exception("%s", self.failure)
            while self._queue.get() is not None:
                self.dropped += 1

    def _write_until_told(self) -> None:
        due = time.monotonic() + FLUSH_EVERY
        while True:
            with contextlib.suppress(queue.Empty):
                item = self._queue.get(timeout=max(0.0, due - time.monotonic()))
                if item is None:
                    break
                self._add(*item)
            if time.monotonic() >= due:
                self._flush()
                due = time.monotonic() + FLUSH_EVERY
        self._flush()
        self._writer.finish()

    def _add(self, key: str, received_ns: int, payload: bytes) -> None:
        stamp_ns, seq, boot = _header(payload, received_ns)
        before = self._last.get(key)
        if before is not None and before[0] == boot and seq > before[1]:
            self.missed += seq - before[1] - 1
        self._last[key] = (boot, seq)
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(key, "msgpack", 0)
        self._writer.add_message(self._channels[key], received_ns, payload, stamp_ns, seq & 0xFFFFFFFF)
        self.written += 1

    def _flush(self) -> None:
        """Close the chunk, so that a reader finds it even if this process dies now; tell what was lost since."""
        losses = {"robot": self._robot, "dropped": str(self.dropped), "missed": str(self.missed)}
        if losses != self._told:
            self._writer.add_metadata(METADATA, losses)
            self._told = losses
        self._writer.flush()


def _header(payload: bytes, received_ns: int) -> tuple[int, int, int]:
    """Stamp [ns], sequence and boot of a message; of bytes that are none, the time of arrival and zeros."""
    try:
        body = msgpack.unpackb(payload)
    except (ValueError, msgpack.UnpackException):
        return received_ns, 0, 0
    if not isinstance(body, dict):
        return received_ns, 0, 0
    stamp_ns, seq, boot = (body.get(name) for name in ("stamp_ns", "seq", "boot"))
    if not (_counts(stamp_ns) and _counts(seq) and _counts(boot)):
        return received_ns, 0, 0
    return stamp_ns, seq, boot


def _counts(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and 0 <= value < 1 << 63


def unused(path: Path) -> Path:
    """The path itself, or the first of `name-2.mcap`, `name-3.mcap`... that does not exist."""
    numbered = (path.with_name(f"{path.stem}-{number}{path.suffix}") for number in itertools.count(2))
    return next(candidate for candidate in itertools.chain([path], numbered) if not candidate.exists())


def run_recorder(robot: str, path: str | Path, connect: Iterable[str] = (), stop: threading.Event | None = None) -> int:
    """Record a robot until SIGTERM, SIGINT or `stop`.

    Args:
        robot: The robot's name.
        path: The file to write; if it exists, a numbered one beside it is written, so that a recorder that was killed
            can be started again as it was.
        connect: More zenoh endpoints, such as a router's.
        stop: Ends the recording in place of the signals.

    Returns:
        The process's exit code; 1 if the recording ended early.

    Raises:
        RecordingError: The file cannot be written.
        AlreadyRunning: The robot is being recorded already.
        ServiceError: No session.
    """
    with (
        until_told(stop) as told,
        Service(robot, "recorder", connect) as service,
        Recorder(service.session, robot, unused(Path(path))) as recorder,
    ):
        service.run(lambda: _status(recorder), told)
    log.info("Recorded %d messages into %s", recorder.written, recorder.path)
    return 1 if recorder.failure else 0


def _status(recorder: Recorder) -> Status:
    losses = recorder.dropped + recorder.missed
    text = recorder.failure or (f"{losses} messages are missing from the recording." if losses else "")
    return Status(
        stamp_ns=time.time_ns(),
        service="recorder",
        state="fault" if recorder.failure else "running",
        text=text,
        facts=recorder.counters(),
    )
