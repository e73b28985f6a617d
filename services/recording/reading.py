"""Reader of recordings: several files, in any order, as one recording; the writer of a file may have been killed."""

import heapq
import json
import logging
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from mcap.records import Channel, Chunk, Footer, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk

from services.errors import RecordingError
from services.recording.schema import Catalogue, Form
from services.recording.writer import FACTS, FORMAT, LOSSES, ROBOT
from services.wire.messages import RECORDS, MessageError
from services.wire.records import Message

log = logging.getLogger(__name__)

Paths = str | Path | Iterable[str | Path]
KINDS = ("dropped", "missed", "malformed")
"""A message may be missing for one of these reasons."""
_BY_TITLE = {f"gemuco.{record.__name__}": record for record in RECORDS.values()}


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording.

    Attributes:
        key: Key on which it was published.
        received_ns: Arrival at the recorder [ns since 1970, the recorder's clock].
        message: The published message.
        form: Form of the message in the file, with units and elements of the signals.
    """

    key: str
    received_ns: int
    message: Message
    form: Form


@dataclass(frozen=True, slots=True)
class FileFacts:
    """Facts that a file holds about itself.

    Attributes:
        path: The file.
        robot: Name of the recorded robot.
        recording: Random name that all files of one recording share.
        part: Number of the file among them.
        condition: Condition of the body; empty if not given.
        described: The HAL's answer to `describe`, at least `signals`.
        losses: Numbers of missing messages up to the end of this file: `dropped`, `missed`, `malformed`.
        keys: Keys that carry messages of gemuco.
        begin_ns: First arrival [ns since 1970]; 0 in an empty file.
        end_ns: Last arrival [ns since 1970].
        is_whole: Whether the file was finished; an unfinished file is readable up to the end of its writer.
    """

    path: Path
    robot: str
    recording: str
    part: int
    condition: str
    described: Mapping[str, Any]
    losses: Mapping[str, int]
    keys: frozenset[str]
    begin_ns: int
    end_ns: int
    is_whole: bool

    @property
    def catalogue(self) -> Catalogue:
        """Signals of the robot, from its last description."""
        return Catalogue.of_description(self.described)


def facts_of(paths: Paths) -> list[FileFacts]:
    """Return the facts of files, in the order of their first arrival.

    Raises:
        RecordingError: No file was named, or a file is missing, damaged at its beginning, or not written by gemuco.
    """
    files = sorted((_facts_of(path) for path in _listed(paths)), key=lambda file: (file.begin_ns, file.part))
    if not files:
        raise RecordingError("No recording was named.")
    return files


def one_robot(files: Iterable[FileFacts]) -> str:
    """Return the name of the robot that all files belong to.

    Raises:
        RecordingError: The files belong to several robots.
    """
    robots = sorted({file.robot for file in files})
    if len(robots) != 1:
        raise RecordingError(
            f"These files are recordings of several robots: {', '.join(robots)}. Name files of one robot only."
        )
    return robots[0]


def losses(paths: Paths) -> dict[str, int]:
    """Return the numbers of `dropped`, `missed` and `malformed` messages, from the last file of each recording.

    Raises:
        RecordingError: As `facts_of`.
    """
    last = {file.recording: file.losses for file in sorted(facts_of(paths), key=lambda file: file.part)}
    return {kind: sum(counts[kind] for counts in last.values()) for kind in KINDS}


def read(paths: Paths, only: Iterable[str] = (), since_ns: int = 0) -> Iterator[Recorded]:
    """Yield the messages of recordings in the order of their arrival; foreign messages are left out.

    Args:
        paths: Files that the recorder wrote, finished or not, in any order.
        only: Keys to read; all if empty.
        since_ns: Arrival of the first message to read [ns since 1970]; earlier ones are not decoded.

    Raises:
        RecordingError: As `facts_of`.
    """
    keys = frozenset(only)
    files = [file for file in facts_of(paths) if file.end_ns >= since_ns]
    for _, recorded in heapq.merge(*(_timed(file, keys, since_ns) for file in files), key=itemgetter(0)):
        if recorded is not None:
            yield recorded


def _timed(file: FileFacts, only: frozenset[str], since_ns: int) -> Iterator[tuple[int, Recorded | None]]:
    """Yield first the begin [ns] of a file without a message, then arrival [ns] and message of its messages.

    The file is opened only after the first entry, because a long recording has more files than a process may open.
    """
    yield file.begin_ns, None
    for recorded in _messages(file.path, only, since_ns):
        yield recorded.received_ns, recorded


def _listed(paths: Paths) -> list[Path]:
    """Return each file once."""
    entries = [paths] if isinstance(paths, str | Path) else paths
    return list(dict.fromkeys(Path(path) for path in entries))


def _messages(path: Path, only: frozenset[str], since_ns: int) -> Iterator[Recorded]:
    forms: dict[int, Form] = {}
    channels: dict[int, tuple[str, Form]] = {}
    for record in _records(path):
        if isinstance(record, McapMessage):
            key, form = channels.get(record.channel_id, ("", None))
            if form is None or (only and key not in only) or record.log_time < since_ns:
                continue
            try:
                yield Recorded(key, record.log_time, form.read(record.data), form)
            except MessageError as error:
                raise RecordingError(f"'{path}' is damaged: {error}") from None
        elif isinstance(record, Schema) and record.name in _BY_TITLE:
            forms[record.id] = _form(path, record)
        elif isinstance(record, Channel) and record.schema_id in forms:
            channels[record.id] = (record.topic, forms[record.schema_id])


def _form(path: Path, schema: Schema) -> Form:
    try:
        return Form(_BY_TITLE[schema.name], Catalogue.of_schema(_object(schema.data)))
    except (ValueError, TypeError, struct.error, MemoryError) as error:
        raise RecordingError(
            f"'{path}' is damaged: its schema of {schema.name} cannot be read ({str(error).rstrip('.')})."
        ) from None


def _object(text: str | bytes) -> dict[str, Any]:
    """Return a JSON object.

    Raises:
        ValueError: The text is not JSON, or another value.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError("its parts are nested too deeply") from None
    if not isinstance(value, dict):
        raise ValueError(f"it is a {type(value).__name__} and not an object")
    return value


def _facts_of(path: Path) -> FileFacts:
    facts: dict[str, dict[str, str]] = {}
    begin_ns, end_ns, is_whole = 0, 0, False
    listed: list[object] = []
    for record in _records(path, whole_chunks=True):
        if isinstance(record, Metadata):
            facts[record.name] = dict(record.metadata)
        elif isinstance(record, Schema | Channel):
            listed.append(record)  # the index at the end repeats them
        elif isinstance(record, Chunk) and record.message_end_time:
            begin_ns = begin_ns or record.message_start_time
            end_ns = record.message_end_time
        elif isinstance(record, Footer):
            is_whole = True
    try:
        own, lost = facts[FACTS], facts.get(LOSSES, {})
        if own["format"] != FORMAT:
            raise RecordingError(
                f"'{path}' is a recording in format {own['format']}; this program reads format {FORMAT}."
            )
        return FileFacts(
            path=path,
            robot=own["robot"],
            recording=own["recording"],
            part=int(own["part"]),
            condition=own["condition"],
            described=_object(facts[ROBOT]["describe"]),
            losses={kind: int(lost.get(kind, 0)) for kind in KINDS},
            keys=_keys(listed if is_whole else _records(path)),
            begin_ns=begin_ns,
            end_ns=end_ns,
            is_whole=is_whole,
        )
    except (KeyError, ValueError):
        raise RecordingError(f"'{path}' is not a recording of `gemuco record`, or only its first bytes.") from None


def _keys(records: Iterable[object]) -> frozenset[str]:
    """Return the topics whose schema belongs to gemuco."""
    own_schemas: set[int] = set()
    topics: set[str] = set()
    for record in records:
        if isinstance(record, Schema) and record.name in _BY_TITLE:
            own_schemas.add(record.id)
        elif isinstance(record, Channel) and record.schema_id in own_schemas:
            topics.add(record.topic)
    return frozenset(topics)


def _records(path: Path, whole_chunks: bool = False) -> Iterator[object]:
    """Yield all records without damaged chunks, up to the end of the file or the last whole record."""
    try:
        stream = path.open("rb")
    except OSError as error:
        raise RecordingError(f"The recording '{path}' cannot be read: {error.strerror}.") from None
    has_record = False
    with stream:
        records = StreamReader(stream, emit_chunks=True).records
        while True:
            try:
                record = next(records, None)
            except Exception as error:  # mcap's reader raises various errors for a cut or damaged file
                if not has_record:
                    reason = str(error) or type(error).__name__
                    raise RecordingError(f"'{path}' is not a recording, or only its first bytes: {reason}.") from None
                return
            if record is None:
                return
            has_record = True
            if isinstance(record, Chunk) and not whole_chunks:
                yield from _unpacked(path, record)
            else:
                yield record


def _unpacked(path: Path, chunk: Chunk) -> list[Any]:
    try:
        return list(breakup_chunk(chunk, validate_crc=True))
    except Exception as error:  # mcap and zstd raise various errors
        log.warning("'%s' is damaged; %d bytes are left out: %s", path, len(chunk.data), error)
        return []
