"""Writer of arriving messages into successive files of a recording, which leaves space on the disk."""

import json
import logging
import os
import secrets
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from services.errors import RecordingError
from services.recording.file import RecordingFile, next_path
from services.recording.losses import ERROR, INFO, LOG, LOG_SCHEMA, Losses, line, line_of_loss
from services.recording.schema import Catalogue, Form, OtherLayout
from services.wire import keys
from services.wire.messages import MessageError
from services.wire.records import Anomaly, Applied, Command, Estimates, Holder, Message, Sample, Status, Target, Update

log = logging.getLogger(__name__)

FORMAT = "2"
FACTS, ROBOT, LOSSES = "gemuco", "gemuco.robot", "gemuco.losses"
"""MCAP metadata with these names hold the facts of the recording, the robot's description, and the losses."""
UNREADABLE = "#unreadable"
"""The topic of messages that are not of the type of their key has this suffix; no zenoh key has a `#`."""
CARRIED: dict[str, type[Message]] = {
    "hal/sample": Sample, "vision/sample": Sample, "simulator/truth": Sample, "hal/applied": Applied,
    "hal/command": Command, "hal/holder": Holder, "model/estimate": Estimates, "model/anomaly": Anomaly,
    "model/update": Update, "model/target": Target, **{f"{service}/status": Status for service in keys.SERVICES},
}  # fmt: skip
"""Key after the robot's name -> type of the messages on it."""
LEAST_FREE = 64 << 20
"""A file ends when the disk has less free space [bytes], so that the robot's other processes can continue."""
TRY_AGAIN = 1.0
"""The next file is tried this long [s] after one could not be written."""
MOST_TOPICS = 1000
"""At most this many keys get a channel of their own; messages of more keys count as dropped."""
MOST_UNKNOWN = 64
"""At most this many signals are recorded that are not in the robot's description."""
LONGEST = 3600.0
"""A file covers at most this time [s], because its index stays in memory, 11 MB per hour (stack/soak.py)."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits at which a file is finished and the next one begun.

    Attributes:
        max_bytes: Size of a file [bytes]; no limit if None.
        max_seconds: Time that a file covers [s]; `LONGEST` if None.
        least_free: Least free space on the disk [bytes]; with less, recording stops until twice this space is free.
    """

    max_bytes: int | None = None
    max_seconds: float | None = None
    least_free: int = LEAST_FREE

    @property
    def is_split(self) -> bool:
        """Whether there may be many files."""
        return self.max_bytes is not None or self.max_seconds is not None


class RecordingWriter:
    """Writer of messages into successive files, for one thread.

    Args:
        path: The file; numbered names are derived from it.
        robot: The robot's name.
        catalogue: The robot's signals, as far as known.
        condition: Condition of the body while it is recorded; empty if not known.
        limits: Limits of one file.
    """

    def __init__(
        self, path: Path, robot: str, catalogue: Catalogue, condition: str = "", limits: Limits | None = None
    ) -> None:
        self.losses = Losses()
        self.written = 0
        """Number of messages that are safely in files."""
        self.foreign = 0
        """Number of messages on keys that are not of gemuco."""
        self.name, self.rate, self.done = "writer", 1.0, 0
        """For health checks: number of commits without a failure."""
        self.failure = ""
        """Reason why nothing is recorded now; empty otherwise."""
        self.paths: list[Path] = []
        """The files so far."""
        self.bytes = 0
        """Size of the finished files [bytes]."""
        self._path, self._robot, self._condition = path, robot, condition
        self._limits = limits or Limits()
        self._identity = secrets.token_hex(8)
        self._catalogue, self._described = catalogue, json.dumps({"signals": catalogue.plain()})
        self._unknown = 0
        self._forms: dict[type[Message], Form] = {}
        self._channels: dict[tuple[str, Form], int] = {}
        self._topics: set[str] = set()
        self._waiting: Counter[str] = Counter()
        self._until_ns = 0
        self._reported: dict[str, str] = {}
        self._holder: str | None = None
        self._retry_at = 0.0
        self._file: RecordingFile | None = None

    @property
    def size(self) -> int:
        """Size on disk of all files [bytes]."""
        return self.bytes + (self._file.size if self._file else 0)

    def open(self, received_ns: int) -> None:
        """Begin the first file.

        Raises:
            RecordingError: The file cannot be written; on a full disk the writer waits for space instead.
        """
        if self._has_room(self._limits.least_free):
            self._begin(received_ns)

    def describe(self, received_ns: int, description: Mapping[str, Any]) -> None:
        """Use the names and units of the HAL's description from now on."""
        try:
            catalogue = Catalogue.of_description(description)
        except MessageError as error:
            log.warning("The HAL of robot '%s' gives no valid description: %s", self._robot, error)
            return
        self._described = msgspec.json.encode(
            {k: v for k, v in description.items() if k not in ("pid", "host")}
        ).decode()
        if catalogue != self._catalogue:
            self._catalogue, self._unknown = catalogue, 0
            self._forms.clear()
        if self._file is not None:
            self._file.add_facts(ROBOT, {"describe": self._described})

    def add(self, key: str, received_ns: int, payload: bytes, encoding: str = "") -> None:
        """Add a message that arrived on a key."""
        if not self._is_open(received_ns):
            self.losses.drop(key)
            return
        carried = CARRIED.get(key.removeprefix(keys.robot_key(self._robot, "")))
        if carried is None:
            self._add_raw(key, received_ns, payload, _name_of(encoding))
            return
        try:
            form, data, body = self._written(carried, payload)
        except MessageError:
            self.losses.malformed[key] += 1
            self._add_raw(key + UNREADABLE, received_ns, payload, "msgpack")
            return
        seq = body.get("seq", 0)
        self.losses.arrived(key, body.get("boot", 0), seq)
        self._put(key, self._channel(key, form), received_ns, data, max(body.get("stamp_ns", 0), 0), seq)
        if carried is Holder:
            self._note_holder(received_ns, body["name"])

    def note(self, received_ns: int, level: int, kind: str, text: str, **more: str | int) -> None:
        """Write a line into the recording's log."""
        self._note(received_ns, line(received_ns, level, kind, text, **more))

    @property
    def error(self) -> str:
        """Reason why nothing is written now, for health checks; empty otherwise."""
        return self.failure

    def commit(self, received_ns: int) -> None:
        """Write added messages to the disk, report losses, and end the file at a limit."""
        self.done += not self.failure
        if self._file is None:
            return
        self._report_losses(received_ns)
        try:
            self._file.commit()
        except OSError as error:
            self._fail(error)
            return
        self._count_written()
        is_big = self._limits.max_bytes is not None and self._file.size >= self._limits.max_bytes
        if is_big or not self._has_room(self._limits.least_free):
            self._end()

    def finish(self, received_ns: int) -> None:
        """Write all messages to the disk and end the last file."""
        self.commit(received_ns)
        self._end()

    def _written(self, carried: type[Message], payload: bytes) -> tuple[Form, bytes, dict[str, Any]]:
        """Return form, JSON and content of a message; elements of unknown signals get numbers as names."""
        while True:
            form = self._forms.get(carried)
            if form is None:
                form = self._forms[carried] = Form(carried, self._catalogue)
            try:
                return form, *form.write(payload)
            except OtherLayout as other:
                if other.signal in self._catalogue.signals or self._unknown >= MOST_UNKNOWN:
                    raise
                self._unknown += 1
                self._catalogue = self._catalogue.with_unknown(other.signal, other.size)
                self._forms.clear()

    def _channel(self, key: str, form: Form) -> int:
        """Return the channel of a key in the current file; a search by schema would take long."""
        if (key, form) not in self._channels:
            assert self._file is not None
            self._channels[key, form] = self._file.channel(key, "json", form.schema["title"], form.schema)
        return self._channels[key, form]

    def _add_raw(self, topic: str, received_ns: int, payload: bytes, encoding: str) -> None:
        if topic not in self._topics and len(self._topics) >= MOST_TOPICS:
            self.losses.dropped[UNREADABLE] += 1
            return
        self._topics.add(topic)
        self.foreign += not topic.endswith(UNREADABLE)
        assert self._file is not None
        self._put(topic, self._file.channel(topic, encoding), received_ns, payload, received_ns, 0)

    def _put(self, key: str, channel: int, received_ns: int, data: bytes, stamp_ns: int, seq: int) -> None:
        assert self._file is not None
        self._file.add(channel, received_ns, stamp_ns, seq, data)
        self._waiting[key] += 1

    def _note(self, received_ns: int, entry: dict[str, Any]) -> None:
        if self._file is not None:
            topic = keys.robot_key(self._robot, "recorder", "log")
            data = msgspec.json.encode(entry)
            self._file.add(self._file.channel(topic, "json", LOG, LOG_SCHEMA), received_ns, received_ns, 0, data)

    def _note_holder(self, received_ns: int, name: str) -> None:
        if name != self._holder:
            self._holder = name
            text = f"{name} commands the robot." if name else "No client commands the robot."
            self.note(received_ns, INFO, "holder", text)

    def _is_open(self, received_ns: int) -> bool:
        """Whether a file is open for a message of this time; at a limit a new file begins."""
        if self._file is not None and 0 < self._until_ns <= received_ns:
            self.commit(received_ns)
            self._end()
        if self._file is None and time.monotonic() >= self._retry_at:
            self._retry_at = time.monotonic() + TRY_AGAIN
            room = self._limits.least_free * (2 if self.failure else 1)
            if self._has_room(room):
                try:
                    self._begin(received_ns)
                except RecordingError as error:
                    self._report(f"Nothing is recorded: {error}")
        return self._file is not None

    def _begin(self, received_ns: int) -> None:
        path = next_path(self._path, self._limits.is_split)
        self._file = RecordingFile(path)
        self._channels.clear()
        self.paths.append(path)
        self._until_ns = received_ns + round(1e9 * min(self._limits.max_seconds or LONGEST, LONGEST))
        part = str(len(self.paths))
        facts = {"format": FORMAT, "robot": self._robot, "recording": self._identity, "part": part}
        self._file.add_facts(FACTS, facts | {"condition": self._condition, "begun_ns": str(received_ns)})
        self._file.add_facts(ROBOT, {"describe": self._described})
        self._reported = {}
        self.note(received_ns, INFO, "file", f"File {part} of recording {self._identity} begins.")
        if self.failure:
            self.note(received_ns, ERROR, "file", f"Before this file: {self.failure}")
            log.warning("The recording continues in '%s'.", path)
            self.failure = ""

    def _end(self) -> None:
        """Write the index and close the file; if the disk has no space for the index, the file is still readable."""
        if self._file is None:
            return
        try:
            self._file.finish()
            self._count_written()
        except OSError as error:
            self._fail(error)
        else:
            self.bytes += self._file.size
        self._file = None
        self._retry_at = 0.0

    def _fail(self, error: OSError) -> None:
        assert self._file is not None
        self._file.abandon()
        if not self._file.path.exists():
            self.paths.remove(self._file.path)
        self.losses.dropped.update(self._waiting)
        self._waiting.clear()
        self.bytes += self._file.size
        self._retry_at = time.monotonic() + TRY_AGAIN
        self._report(f"Nothing is recorded: '{self._file.path}' could not be written any more: {error.strerror}.")
        self._file = None

    def _count_written(self) -> None:
        self.written += self._waiting.total()
        self._waiting.clear()

    def _has_room(self, needed: int) -> bool:
        """Whether the disk has this many free bytes; if not, report it."""
        folder = next(parent for parent in self._path.absolute().parents if parent.is_dir())
        disk = os.statvfs(folder)
        free = disk.f_bavail * disk.f_frsize
        if free < needed:
            self._report(
                f"Nothing is recorded: the disk of '{folder}' has {free / 1e6:.0f} MB left. Recording "
                f"continues with {2 * self._limits.least_free / 1e6:.0f} MB."
            )
        return free >= needed

    def _report(self, text: str) -> None:
        if not self.failure:
            log.error("%s", text)
        self.failure = text

    def _report_losses(self, received_ns: int) -> None:
        for loss in self.losses.news():
            self._note(received_ns, line_of_loss(received_ns, *loss))
        facts = self.losses.facts()
        if facts != self._reported and self._file is not None:
            self._file.add_facts(LOSSES, facts)
            self._reported = facts


def _name_of(encoding: str) -> str:
    """Return MCAP's name for the encoding of a zenoh message."""
    plain = encoding.partition(";")[0].lower()
    known = {"application/json": "json", "text/json": "json", "application/msgpack": "msgpack",
             "application/protobuf": "protobuf", "application/cbor": "cbor", "application/cdr": "cdr"}  # fmt: skip
    return known.get(plain, plain)
