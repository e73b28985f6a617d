"""The process that writes down all that a robot's services publish, in files that Foxglove opens.

Whatever was received more than a second ago survives kill -9, and, as far as the disk keeps its word, a power cut. What
was lost is counted and written into the file. Nothing here can hold up zenoh, nor grow without bound.
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
from services.process.service import Service, until_told
from services.recording.losses import INFO, WARNING
from services.recording.schema import Catalogue
from services.recording.writer import Limits, RecordingWriter
from services.wire import keys, query
from services.wire.messages import Status

log = logging.getLogger(__name__)

MOST = 8192
"""Messages that may wait to be written; at five streams of 200 Hz, eight seconds of a disk that stalls."""
MOST_BYTES = 32 << 20
"""Bytes that may wait."""
TAKE_EVERY = 0.05
COMMIT_EVERY = 0.4
"""How often [s] what came is made safe; with the time to write it, under a second."""
DESCRIBED_WITHIN = 0.5
"""How long [s] writing waits for the HAL to tell the names of its signals, where no robot file does."""
ASK_WITHIN = 1.0
STEPPED = 500_000_000
"""A wall clock that jumps by so many ns is told."""


class Arrived(NamedTuple):
    """Something to write down: a `message`, that a service came (`alive`) or went (`gone`), or what a `robot` is."""

    kind: str
    key: str
    received_ns: int
    payload: bytes = b""
    encoding: str = ""
    told: Mapping[str, Any] | None = None


class Waiting:
    """What came and is not written yet, bounded in number and bytes."""

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._lock = threading.Lock()
        self._items: list[Arrived] = []
        self._bytes = 0
        self._dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Arrived) -> None:
        """Add one, or count it as dropped; never waits for anything that takes long."""
        with self._lock:
            if len(self._items) >= self._most or self._bytes + len(item.payload) > self._most_bytes:
                # Of keys without number, each dropped one must not be remembered.
                self._dropped[item.key if len(self._dropped) < self._most else ""] += 1
                return
            self._items.append(item)
            self._bytes += len(item.payload)

    def take(self) -> tuple[list[Arrived], Counter[str]]:
        """All that wait, in order, and what was dropped since the last call, by key."""
        with self._lock:
            found = self._items, self._dropped
            self._items, self._bytes, self._dropped = [], 0, Counter()
        return found


class ArrivalClock:
    """The wall clock at the start, going on like a clock that nobody sets: arrivals never go back in time."""

    def __init__(self) -> None:
        self._ahead = time.time_ns() - time.monotonic_ns()
        self._stepped = 0

    def now_ns(self) -> int:
        """Nanoseconds since 1970, by the wall clock as it was at the start."""
        return self._ahead + time.monotonic_ns()

    def step(self) -> float:
        """By how much [s] somebody set the wall clock since the last call."""
        apart = time.time_ns() - self.now_ns()
        step = apart - self._stepped
        if abs(step) < STEPPED:
            return 0.0
        self._stepped = apart
        return step * 1e-9


class Recorder:
    """Records a robot's keys, from entering to leaving.

    Args:
        session: An open session; it must outlive the recorder.
        robot: The robot's name.
        writer: Writes the files.
        is_described: Whether the writer knows the robot's signals; if not, the HAL is asked first.
        most: How many messages may wait to be written; more are dropped and counted.
    """

    def __init__(
        self, session: zenoh.Session, robot: str, writer: RecordingWriter, is_described: bool = True, most: int = MOST
    ) -> None:
        self.writer = writer
        self.failure = ""
        """Why writing ended early; empty while all is well."""
        self._session, self._robot = session, robot
        self._waiting = Waiting(most, MOST_BYTES)
        self._clock = ArrivalClock()
        self._stop = threading.Event()
        self._hal_came = threading.Event()
        self._known = threading.Event()
        if is_described:
            self._known.set()

    def __enter__(self) -> Self:
        self.writer.open(self._clock.now_ns())
        self._writing = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._asking = threading.Thread(target=self._describe, name="ask the HAL", daemon=True)
        self._writing.start()
        self._asking.start()
        session, robot = self._session, self._robot
        self._subscriber = session.declare_subscriber(keys.everything(robot), self._receive)
        self._tokens = session.liveliness().declare_subscriber(keys.alive(robot, "*"), self._came_or_went, history=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._subscriber.undeclare()
        self._tokens.undeclare()
        self._stop.set()
        self._hal_came.set()
        self._writing.join()
        self._asking.join()

    def counters(self) -> dict[str, Any]:
        """What was written and where, what was lost, and why nothing is recorded now, if so."""
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
        """In zenoh's thread: note the time, never wait."""
        now = self._clock.now_ns()
        self._waiting.put(
            Arrived("message", str(sample.key_expr), now, sample.payload.to_bytes(), str(sample.encoding))
        )

    def _came_or_went(self, sample: zenoh.Sample) -> None:
        came = sample.kind == zenoh.SampleKind.PUT
        key = str(sample.key_expr)
        self._waiting.put(Arrived("alive" if came else "gone", key, self._clock.now_ns()))
        if came and key == keys.alive(self._robot, "hal"):
            self._hal_came.set()

    def _describe(self) -> None:
        """Ask every HAL that comes what its signals are."""
        while self._hal_came.wait() and not self._stop.is_set():
            self._hal_came.clear()
            with contextlib.suppress(ServiceError):  # not allowed, or gone again: then signals have numbers for names
                told = query.ask(self._session, keys.verb(self._robot, "hal", "describe"), timeout=ASK_WITHIN)
                self._waiting.put(Arrived("robot", "", self._clock.now_ns(), told=told))
            self._known.set()

    def _write(self) -> None:
        self._known.wait(DESCRIBED_WITHIN)
        try:
            self._write_until_told()
        except Exception as error:  # whatever it was, what comes from now on counts as dropped, and is told
            self.failure = f"The recording ended early: {type(error).__name__}: {error}."
            log.exception("%s", self.failure)
            while not self._stop.wait(TAKE_EVERY):
                self._drop_all()
            self._drop_all()

    def _write_until_told(self) -> None:
        due = time.monotonic() + COMMIT_EVERY
        while not (is_last := self._stop.wait(TAKE_EVERY)):
            self._take()
            if time.monotonic() >= due:
                if step := self._clock.step():
                    text = (
                        f"The wall clock of the recorder's machine was set by {step:+.3f} s; arrivals go on as before."
                    )
                    self.writer.note(self._clock.now_ns(), WARNING, "clock", text)
                self.writer.commit(self._clock.now_ns())
                due = time.monotonic() + COMMIT_EVERY
        if is_last:
            self._take()
        self.writer.finish(self._clock.now_ns())

    def _take(self) -> None:
        items, dropped = self._waiting.take()
        # What the HAL tells of itself comes before messages that waited for it.
        for item in sorted(items, key=lambda one: one.kind != "robot"):
            self._add(item)
        for key, count in dropped.items():  # they came after those that found room
            self.writer.losses.drop(key, count)

    def _add(self, item: Arrived) -> None:
        if item.kind == "message":
            self.writer.add(item.key, item.received_ns, item.payload, item.encoding)
        elif item.told is not None:
            self.writer.describe(item.received_ns, item.told)
        else:
            service = keys.parse(item.key)[1]
            text = f"The '{service}' service {'came' if item.kind == 'alive' else 'went'}."
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
    """Record a robot while the context lasts.

    Args:
        session: An open session.
        robot: The robot's name.
        path: The file, or what its numbered names are made from.
        catalogue: The robot's signals; its HAL is asked if not given.
        condition: How the body is meanwhile.
        limits: When to begin a new file.

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
        path: The file to write; if it exists, or where there may be many, numbered ones beside it are written, so that
            a recorder that was killed can be started again as it was.
        connect: Endpoints, such as a router's, and role files.
        stop: Ends the recording in place of the signals.
        catalogue: The robot's signals; its HAL is asked if not given.
        condition: How the body is meanwhile.
        limits: When to begin a new file.

    Returns:
        The process's exit code; 1 if something that came could not be written.

    Raises:
        RecordingError: The file cannot be written.
        AlreadyRunning: The robot is being recorded already.
        ServiceError: No session.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        raise RecordingError(f"A recording's name ends in .mcap, unlike '{path}'.")
    began = time.monotonic()
    with (
        until_told(stop) as told,
        Service(robot, "recorder", connect) as service,
        recording(service.session, robot, path, catalogue, condition, limits) as recorder,
    ):
        service.watch(recorder.writer)
        service.run(lambda: _status(recorder), told)
    counted = recorder.counters()
    print(summary(recorder, time.monotonic() - began))
    return 1 if counted["failure"] or counted["dropped"] else 0


def summary(recorder: Recorder, seconds: float) -> str:
    """What was recorded, and what is missing, for a person."""
    told = recorder.counters()
    files = recorder.writer.paths
    where = (
        f"{files[0]}" + (f" to {files[-1].name} ({len(files)} files)" if len(files) > 1 else "") if files else "no file"
    )
    text = f"{told['written']} messages, {seconds:.1f} s, {told['bytes'] / 1e6:.2f} MB in {where}. {missing(told)}"
    return f"{text} {told['failure']}".rstrip()


def missing(told: Mapping[str, Any]) -> str:
    """What a recording lacks, in one sentence."""
    said = {
        "dropped": "could not be written",
        "missed": "never arrived here",
        "malformed": "were not what their key carries (kept as bytes)",
    }
    found = [f"{told[kind]} {text}" for kind, text in said.items() if told[kind]]
    return f"Of its messages {', '.join(found)}." if found else "Nothing is missing."


def _status(recorder: Recorder) -> Status:
    told = recorder.counters()
    lost = told["dropped"] + told["missed"]
    text = told["failure"] or (f"{lost} messages are missing from the recording." if lost else "")
    return Status(
        stamp_ns=time.time_ns(),
        service="recorder",
        state="fault" if told["failure"] else "running",
        text=text,
        facts=told,
    )
