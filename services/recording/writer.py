"""From messages as they arrive to the files of a recording, one after the other; no disk is filled to the last byte."""

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
"""Names of the metadata: what the recording is, the robot's description, what is missing."""
UNREADABLE = "#unreadable"
"""Added to the topic of messages that are not what their key carries; no zenoh key has a `#`."""
CARRIED: dict[str, type[Message]] = {
    "hal/sample": Sample, "vision/sample": Sample, "simulator/truth": Sample, "hal/applied": Applied,
    "hal/command": Command, "hal/holder": Holder, "model/estimate": Estimates, "model/anomaly": Anomaly,
    "model/update": Update, "model/target": Target, **{f"{service}/status": Status for service in keys.SERVICES},
}  # fmt: skip
"""What each key carries, by what follows the robot's name."""
LEAST_FREE = 64 << 20
"""A file is finished when the disk has less left [bytes], so that the robot's other processes can go on."""
TRY_AGAIN = 1.0
"""How long [s] after a file could not be written the next one is tried."""
MOST_TOPICS = 1000
"""Keys that get a channel of their own; messages of more count as dropped."""
MOST_UNKNOWN = 64
"""Signals that are not in the robot's description and are recorded all the same."""
LONGEST = 3600.0
"""What one file covers at most [s]: the index of its parts stays in memory, 11 MB of it an hour (stack/soak.py)."""


@dataclass(frozen=True, slots=True)
class Limits:
    """When a file is finished and the next one begun.

    Attributes:
        max_bytes: When it has this size; never if None.
        max_seconds: When it covers this long [s]; after `LONGEST` if None.
        least_free: When the disk has less left [bytes]; then nothing is recorded until it has twice as much.
    """

    max_bytes: int | None = None
    max_seconds: float | None = None
    least_free: int = LEAST_FREE

    @property
    def is_split(self) -> bool:
        """Whether there may be many files."""
        return self.max_bytes is not None or self.max_seconds is not None


class RecordingWriter:
    """Writes messages into one file after the other; used by one thread.

    Args:
        path: The file, or what its numbered names are made from.
        robot: The robot's name.
        catalogue: Its signals, as far as known.
        condition: How the body is while it is recorded; empty if not told.
        limits: When to begin a new file.
    """

    def __init__(
        self, path: Path, robot: str, catalogue: Catalogue, condition: str = "", limits: Limits | None = None
    ) -> None:
        self.losses = Losses()
        self.written = 0
        """Messages that are safe in files."""
        self.foreign = 0
        """Of those, such on keys that are not ours."""
        self.name, self.rate, self.done = "writer", 1.0, 0
        """For health checks: how often it was asked to make everything safe, and nothing was in the way."""
        self.failure = ""
        """Why nothing is recorded now; empty while all is well."""
        self.paths: list[Path] = []
        """The files so far."""
        self.bytes = 0
        """Their size, without the one being written."""
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
        self._told: dict[str, str] = {}
        self._holder: str | None = None
        self._again = 0.0
        self._file: RecordingFile | None = None

    @property
    def size(self) -> int:
        """Bytes on disk in all files."""
        return self.bytes + (self._file.size if self._file else 0)

    def open(self, received_ns: int) -> None:
        """Begin the first file.

        Raises:
            RecordingError: It cannot be written; a full disk is no error, but waited for.
        """
        if self._has_room(self._limits.least_free):
            self._begin(received_ns)

    def describe(self, received_ns: int, told: Mapping[str, Any]) -> None:
        """Take the names and units from what the HAL told of itself, from now on."""
        try:
            catalogue = Catalogue.of_description(told)
        except MessageError as error:
            log.warning("The HAL of robot '%s' describes itself badly: %s", self._robot, error)
            return
        self._described = msgspec.json.encode({k: v for k, v in told.items() if k not in ("pid", "host")}).decode()
        if catalogue != self._catalogue:
            self._catalogue, self._unknown = catalogue, 0
            self._forms.clear()
        if self._file is not None:
            self._file.tell(ROBOT, {"describe": self._described})

    def add(self, key: str, received_ns: int, payload: bytes, encoding: str = "") -> None:
        """Add what arrived on a key."""
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
        """Why nothing is written now, for health checks; empty while all is well."""
        return self.failure

    def commit(self, received_ns: int) -> None:
        """Make what was added safe; tell what was lost since; end the file if the disk is nearly full."""
        self.done += not self.failure
        if self._file is None:
            return
        self._tell_losses(received_ns)
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
        """Make everything safe, and end the last file."""
        self.commit(received_ns)
        self._end()

    def _written(self, carried: type[Message], payload: bytes) -> tuple[Form, bytes, dict[str, Any]]:
        """The JSON of a message and its content, with signals that nobody described numbered instead of named."""
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
        """The channel of a key in the file that is being written; looking it up by its schema would take long."""
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

    def _note(self, received_ns: int, told: dict[str, Any]) -> None:
        if self._file is not None:
            topic = keys.robot_key(self._robot, "recorder", "log")
            data = msgspec.json.encode(told)
            self._file.add(self._file.channel(topic, "json", LOG, LOG_SCHEMA), received_ns, received_ns, 0, data)

    def _note_holder(self, received_ns: int, name: str) -> None:
        if name != self._holder:
            self._holder = name
            text = f"{name} commands the robot." if name else "Nobody commands the robot."
            self.note(received_ns, INFO, "holder", text)

    def _is_open(self, received_ns: int) -> bool:
        """Whether there is a file for a message of this time; a new one is begun where the limits say so."""
        if self._file is not None and 0 < self._until_ns <= received_ns:
            self.commit(received_ns)
            self._end()
        if self._file is None and time.monotonic() >= self._again:
            self._again = time.monotonic() + TRY_AGAIN
            room = self._limits.least_free * (2 if self.failure else 1)
            if self._has_room(room):
                try:
                    self._begin(received_ns)
                except RecordingError as error:
                    self._say(f"Nothing is recorded: {error}")
        return self._file is not None

    def _begin(self, received_ns: int) -> None:
        path = next_path(self._path, self._limits.is_split)
        self._file = RecordingFile(path)
        self._channels.clear()
        self.paths.append(path)
        self._until_ns = received_ns + round(1e9 * min(self._limits.max_seconds or LONGEST, LONGEST))
        part = str(len(self.paths))
        facts = {"format": FORMAT, "robot": self._robot, "recording": self._identity, "part": part}
        self._file.tell(FACTS, facts | {"condition": self._condition, "begun_ns": str(received_ns)})
        self._file.tell(ROBOT, {"describe": self._described})
        self._told = {}
        self.note(received_ns, INFO, "file", f"File {part} of recording {self._identity} begins.")
        if self.failure:
            self.note(received_ns, ERROR, "file", f"Before this file: {self.failure}")
            log.warning("Recording goes on in '%s'.", path)
            self.failure = ""

    def _end(self) -> None:
        """Write the index; without one, where there is no space for it, the file is readable all the same."""
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
        self._again = 0.0

    def _fail(self, error: OSError) -> None:
        assert self._file is not None
        self._file.abandon()
        if not self._file.path.exists():
            self.paths.remove(self._file.path)
        self.losses.dropped.update(self._waiting)
        self._waiting.clear()
        self.bytes += self._file.size
        self._again = time.monotonic() + TRY_AGAIN
        self._say(f"Nothing is recorded: '{self._file.path}' could not be written on: {error.strerror}.")
        self._file = None

    def _count_written(self) -> None:
        self.written += self._waiting.total()
        self._waiting.clear()

    def _has_room(self, wanted: int) -> bool:
        """Whether the disk has so many bytes left; if not, that is told."""
        folder = next(one for one in self._path.absolute().parents if one.is_dir())
        found = os.statvfs(folder)
        free = found.f_bavail * found.f_frsize
        if free < wanted:
            self._say(
                f"Nothing is recorded: the disk of '{folder}' has {free / 1e6:.0f} MB left. It goes on when there are "
                f"{2 * self._limits.least_free / 1e6:.0f} MB."
            )
        return free >= wanted

    def _say(self, text: str) -> None:
        if not self.failure:
            log.error("%s", text)
        self.failure = text

    def _tell_losses(self, received_ns: int) -> None:
        for loss in self.losses.news():
            self._note(received_ns, line_of_loss(received_ns, *loss))
        facts = self.losses.facts()
        if facts != self._told and self._file is not None:
            self._file.tell(LOSSES, facts)
            self._told = facts


def _name_of(encoding: str) -> str:
    """MCAP's name for the encoding of a zenoh message."""
    plain = encoding.partition(";")[0].lower()
    known = {"application/json": "json", "text/json": "json", "application/msgpack": "msgpack",
             "application/protobuf": "protobuf", "application/cbor": "cbor", "application/cdr": "cdr"}  # fmt: skip
    return known.get(plain, plain)
