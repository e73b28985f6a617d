"""Process that records everything that a robot's services publish, in files that Foxglove opens.

After one second a message is safe against kill -9, and against a power cut if the disk flushes as requested. Losses are
counted and written into the file. The recorder never blocks zenoh, and its memory is bounded.
"""

import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh

from services.errors import RecordingError, ServiceError
from services.process.service import Service, until_stopped
from services.recording.losses import INFO, WARNING
from services.recording.schema import Catalogue
from services.recording.writer import Limits, RecordingWriter
from services.wire import keys, query
from services.wire.messages import Status

log = logging.getLogger(__name__)

MOST = 8192
"""At most this many messages wait to be written: five streams of 200 Hz while the disk stops for eight seconds."""
MOST_BYTES = 32 << 20
"""At most this many bytes wait to be written."""
TAKE_EVERY = 0.05
COMMIT_EVERY = 0.4
"""Messages are written at this interval [s], so that each is safe within a second."""
DESCRIBED_WITHIN = 0.5
"""Without a robot file, writing waits at most this long [s] for the HAL to name its signals."""
ASK_WITHIN = 1.0
SILENT = "No message of robot '{}' has arrived: is its name right, and is a service of it running?"
LEAST_STEP = 500_000_000
"""A jump of the wall clock by at least this [ns] is reported."""


class Entry(NamedTuple):
    """Event to record: a `message`, a service that started (`alive`) or ended (`gone`), or a description (`robot`)."""

    kind: str
    key: str
    received_ns: int
    payload: bytes = b""
    encoding: str = ""
    description: Mapping[str, Any] | None = None


class EntryQueue:
    """Entries that wait to be written, bounded in number and bytes."""

    def __init__(self, limit: int, limit_bytes: int) -> None:
        self._limit, self._limit_bytes = limit, limit_bytes
        self._lock = threading.Lock()
        self._items: list[Entry] = []
        self._bytes = 0
        self._dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Entry) -> None:
        """Add an entry, or count it as dropped; never blocks for long."""
        with self._lock:
            if len(self._items) >= self._limit or self._bytes + len(item.payload) > self._limit_bytes:
                # Clients may make any number of keys, so not every dropped key is stored.
                self._dropped[item.key if len(self._dropped) < self._limit else ""] += 1
                return
            self._items.append(item)
            self._bytes += len(item.payload)

    def take(self) -> tuple[list[Entry], Counter[str]]:
        """Return and remove all entries in order, and the number dropped since the last call, by key."""
        with self._lock:
            items, dropped = self._items, self._dropped
            self._items, self._bytes, self._dropped = [], 0, Counter()
        return items, dropped


class SteadyClock:
    """Clock that starts at wall-clock time and is never set afterwards, so that arrivals never go back in time."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._reported_ns = 0

    def now_ns(self) -> int:
        """Return the time [ns since 1970] by the wall clock at the start."""
        return self._offset_ns + time.monotonic_ns()

    def step(self) -> float:
        """Return the step of the wall clock since the last call [s]; 0 for a step below `LEAST_STEP`."""
        difference = time.time_ns() - self.now_ns()
        step = difference - self._reported_ns
        if abs(step) < LEAST_STEP:
            return 0.0
        self._reported_ns = difference
        return step * 1e-9


class Recorder:
    """Recording of a robot's keys; a context manager.

    Args:
        session: An open session; it must outlive the recorder.
        robot: The robot's name.
        writer: Writer of the files.
        is_described: Whether the writer has the robot's signals; if not, the HAL is queried first.
        limit: At most this many messages wait to be written; more are dropped and counted.
    """

    def __init__(
        self, session: zenoh.Session, robot: str, writer: RecordingWriter, is_described: bool = True, limit: int = MOST
    ) -> None:
        self.writer = writer
        self.failure = ""
        """Reason why writing ended early; empty otherwise."""
        self._session, self.robot = session, robot
        self._waiting = EntryQueue(limit, MOST_BYTES)
        self._clock = SteadyClock()
        self._stop = threading.Event()
        self._has_new_hal = threading.Event()
        self._own_status = keys.status(robot, "recorder")
        self.is_heard = False
        """Whether a message of one of the robot's other services has arrived."""
        self._is_described = threading.Event()
        if is_described:
            self._is_described.set()

    def __enter__(self) -> Self:
        self.writer.open(self._clock.now_ns())
        self._writing = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._asking = threading.Thread(target=self._describe, name="ask the HAL", daemon=True)
        self._writing.start()
        self._asking.start()
        session, robot = self._session, self.robot
        self._subscriber = session.declare_subscriber(keys.everything(robot), self._receive)
        self._tokens = session.liveliness().declare_subscriber(
            keys.alive(robot, "*"), self._receive_token, history=True
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._subscriber.undeclare()
        self._tokens.undeclare()
        self._stop.set()
        self._has_new_hal.set()
        self._writing.join()
        self._asking.join()

    def counters(self) -> dict[str, Any]:
        """Return counts of written and lost messages, the file, and the failure if nothing is recorded now."""
        writer = self.writer
        return {
            "path": str(writer.paths[-1]) if writer.paths else "",
            "files": len(writer.paths),
            "bytes": writer.size,
            "written": writer.written,
            "foreign": writer.foreign,
            **writer.losses.totals(),
            "waiting": len(self._waiting),
            "failure": self.failure or writer.failure,
        }

    def _receive(self, sample: zenoh.Sample) -> None:
        """Queue a message with its arrival; runs in zenoh's thread and never blocks."""
        now, key = self._clock.now_ns(), str(sample.key_expr)
        self.is_heard = self.is_heard or key != self._own_status
        self._waiting.put(Entry("message", key, now, sample.payload.to_bytes(), str(sample.encoding)))

    def _receive_token(self, sample: zenoh.Sample) -> None:
        is_alive = sample.kind == zenoh.SampleKind.PUT
        key = str(sample.key_expr)
        self._waiting.put(Entry("alive" if is_alive else "gone", key, self._clock.now_ns()))
        if is_alive and key == keys.alive(self.robot, "hal"):
            self._has_new_hal.set()

    def _describe(self) -> None:
        """Query every HAL that starts for its signals."""
        while self._has_new_hal.wait() and not self._stop.is_set():
            self._has_new_hal.clear()
            with contextlib.suppress(ServiceError):  # not allowed, or ended again: then signals have numbers for names
                description = query.ask(self._session, keys.verb(self.robot, "hal", "describe"), timeout=ASK_WITHIN)
                self._waiting.put(Entry("robot", "", self._clock.now_ns(), description=description))
            self._is_described.set()

    def _write(self) -> None:
        self._is_described.wait(DESCRIBED_WITHIN)
        try:
            self._write_until_stopped()
        except Exception as error:  # later messages count as dropped, and the failure is reported
            self.failure = f"The recording ended early: {type(error).__name__}: {error}."
            log.exception("%s", self.failure)
            while not self._stop.wait(TAKE_EVERY):
                self._drop_all()
            self._drop_all()

    def _write_until_stopped(self) -> None:
        due = time.monotonic() + COMMIT_EVERY
        while not self._stop.wait(TAKE_EVERY):
            self._take()
            if time.monotonic() >= due:
                if step := self._clock.step():
                    text = f"The wall clock of the recorder's machine was set by {step:+.3f} s; arrivals have no step."
                    self.writer.note(self._clock.now_ns(), WARNING, "clock", text)
                self.writer.commit(self._clock.now_ns())
                due = time.monotonic() + COMMIT_EVERY
        self._take()
        self.writer.finish(self._clock.now_ns())

    def _take(self) -> None:
        items, dropped = self._waiting.take()
        # Descriptions come before the messages that waited for them.
        for item in sorted(items, key=lambda item: item.kind != "robot"):
            self._add(item)
        for key, count in dropped.items():  # they arrived after the queued messages
            self.writer.losses.drop(key, count)

    def _add(self, item: Entry) -> None:
        if item.kind == "message":
            self.writer.add(item.key, item.received_ns, item.payload, item.encoding)
        elif item.description is not None:
            self.writer.describe(item.received_ns, item.description)
        else:
            service = keys.parse(item.key)[1]
            text = f"The '{service}' service {'started' if item.kind == 'alive' else 'ended'}."
            level = INFO if item.kind == "alive" else WARNING
            self.writer.note(item.received_ns, level, item.kind, text, key=item.key)

    def _drop_all(self) -> None:
        items, dropped = self._waiting.take()
        dropped.update(item.key for item in items if item.kind == "message")
        for key, count in dropped.items():
            self.writer.losses.drop(key, count)


@contextlib.contextmanager
def recording(
    session: zenoh.Session,
    robot: str,
    path: Path,
    catalogue: Catalogue | None = None,
    condition: str = "",
    limits: Limits | None = None,
) -> Iterator[Recorder]:
    """Record a robot until the context ends.

    Args:
        session: An open session.
        robot: The robot's name.
        path: The file; numbered names are derived from it.
        catalogue: The robot's signals; the HAL is queried if None.
        condition: Condition of the body during the recording.
        limits: Limits at which a new file begins.

    Raises:
        RecordingError: The first file cannot be written.
    """
    writer = RecordingWriter(path, robot, catalogue or Catalogue({}), condition, limits)
    with Recorder(session, robot, writer, catalogue is not None) as recorder:
        yield recorder


def run_recorder(
    robot: str,
    path: str | Path,
    connect: Iterable[str] = (),
    stop: threading.Event | None = None,
    *,
    catalogue: Catalogue | None = None,
    condition: str = "",
    limits: Limits | None = None,
) -> int:
    """Record a robot until SIGTERM, SIGINT or `stop`.

    Args:
        robot: The robot's name.
        path: The file to write. If `path` exists, or if there may be many files, numbered files are written beside it,
            so a killed recorder can be started again with the same arguments.
        connect: Endpoints, such as a router's, and role files.
        stop: Event that ends the recording, in place of SIGTERM and SIGINT.
        catalogue: The robot's signals; the HAL is queried if None.
        condition: Condition of the body during the recording.
        limits: Limits at which a new file begins.

    Returns:
        Exit code of the process; 1 if a message could not be written.

    Raises:
        RecordingError: The file cannot be written.
        AlreadyRunning: The robot is being recorded already.
        ServiceError: No session could be opened.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        raise RecordingError(f"A recording's name ends in .mcap; '{path}' does not.")
    began = time.monotonic()
    with (
        until_stopped(stop) as stopped,
        Service(robot, "recorder", connect) as service,
        recording(service.session, robot, path, catalogue, condition, limits) as recorder,
    ):
        service.watch(recorder.writer)
        service.run(lambda: _status(recorder), stopped)
    counters = recorder.counters()
    print(summary(recorder, time.monotonic() - began))
    return 1 if counters["failure"] or counters["dropped"] else 0


def summary(recorder: Recorder, seconds: float) -> str:
    """Return sentences on the recorded and the missing messages."""
    counters = recorder.counters()
    lack = missing(counters) if recorder.is_heard else SILENT.format(recorder.robot)
    files = recorder.writer.paths
    place = (
        f"{files[0]}" + (f" to {files[-1].name} ({len(files)} files)" if len(files) > 1 else "") if files else "no file"
    )
    text = f"{counters['written']} messages, {seconds:.1f} s, {counters['bytes'] / 1e6:.2f} MB in {place}."
    return f"{text} {lack} {counters['failure']}".rstrip()


def missing(counters: Mapping[str, Any]) -> str:
    """Return one sentence on the messages that a recording lacks."""
    reasons = {
        "dropped": "could not be written",
        "missed": "never arrived here",
        "malformed": "were not of the type of their key (kept as bytes)",
    }
    parts = [f"{counters[kind]} {text}" for kind, text in reasons.items() if counters[kind]]
    return f"Of the messages, {', '.join(parts)}." if parts else "Nothing is missing."


def _status(recorder: Recorder) -> Status:
    counters = recorder.counters()
    lost = counters["dropped"] + counters["missed"]
    silent = "" if recorder.is_heard else SILENT.format(recorder.robot)
    text = counters["failure"] or (f"{lost} messages are missing from the recording." if lost else silent)
    return Status(
        stamp_ns=time.time_ns(),
        service="recorder",
        state="fault" if counters["failure"] else "running",
        text=text,
        facts=counters,
    )
