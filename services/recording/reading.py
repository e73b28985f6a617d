"""Read recordings back: several files as one, in any order, also those whose writer was killed."""

import heapq
import json
import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Channel, Chunk, Footer, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk

from services.errors import RecordingError
from services.recording.losses import LOG
from services.recording.schema import Catalogue, Form
from services.recording.writer import FACTS, FORMAT, LOSSES, ROBOT
from services.wire.messages import RECORDS, MessageError
from services.wire.records import Message

log = logging.getLogger(__name__)

Paths = str | Path | Iterable[str | Path]
KINDS = ("dropped", "missed", "malformed")
"""In which ways a message may be missing."""
_BY_TITLE = {f"gemuco.{record.__name__}": record for record in RECORDS.values()}


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording.

    Attributes:
        key: On which key it was published.
        received_ns: When the recorder received it [ns since 1970, the recorder's clock].
        message: What was published.
        form: How it looks in the file; tells the signals' units and elements.
    """

    key: str
    received_ns: int
    message: Message
    form: Form


@dataclass(frozen=True, slots=True)
class About:
    """What a file tells of itself.

    Attributes:
        path: The file.
        robot: Whose recording it is.
        recording: Random name that the files of one recording share.
        part: Its number among them.
        condition: How the body was; empty if not told.
        described: What the HAL told of itself, at least `signals`.
        losses: Messages that are missing from the recording up to here: `dropped`, `missed`, `malformed`.
        keys: Keys with messages of ours.
        begin_ns: First arrival; 0 in an empty file.
        end_ns: Last arrival.
        is_whole: Whether it was finished; one that was not is readable up to where its writer was killed.
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
        """The robot's signals as it described them last."""
        return Catalogue.of_description(self.described)


def about(paths: Paths) -> list[About]:
    """What files tell of themselves, in the order of their first arrival.

    Raises:
        RecordingError: No file, or one is missing, damaged at its beginning, or no recording of ours.
    """
    found = sorted((_about(path) for path in _listed(paths)), key=lambda one: (one.begin_ns, one.part))
    if not found:
        raise RecordingError("No recording was named.")
    return found


def one_robot(files: Iterable[About]) -> str:
    """The robot that all these files are about.

    Raises:
        RecordingError: There are several.
    """
    robots = sorted({one.robot for one in files})
    if len(robots) != 1:
        raise RecordingError(f"These files are recordings of several robots: {', '.join(robots)}. Take those of one.")
    return robots[0]


def losses(paths: Paths) -> dict[str, int]:
    """How many messages are missing from recordings: `dropped`, `missed`, `malformed`, as the last files tell.

    Raises:
        RecordingError: As `about`.
    """
    last = {one.recording: one.losses for one in sorted(about(paths), key=lambda one: one.part)}
    return {kind: sum(each[kind] for each in last.values()) for kind in KINDS}


def read(paths: Paths, wanted: Iterable[str] = ()) -> Iterator[Recorded]:
    """The messages of recordings in the order of their arrival; what is no message of ours is left out.

    Args:
        paths: Files that the recorder wrote, finished or not, in any order.
        wanted: Keys to read; all if none is given.

    Raises:
        RecordingError: As `about`.
    """
    keys = frozenset(wanted)
    later = about(paths)[::-1]
    heap: list[tuple[int, int, Recorded, Iterator[Recorded]]] = []
    number = 0
    while later or heap:
        # Files are opened when their time has come: a long recording has more of them than a process may open.
        while later and (not heap or later[-1].begin_ns <= heap[0][0]):
            one = _messages(later.pop().path, keys)
            number += 1
            if (first := next(one, None)) is not None:
                heapq.heappush(heap, (first.received_ns, number, first, one))
        if not heap:
            continue
        _, which, recorded, rest = heap[0]
        following = next(rest, None)
        if following is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following.received_ns, which, following, rest))
        yield recorded


def log_lines(path: str | Path) -> Iterator[dict[str, Any]]:
    """What a file's log tells: who came and went, what was lost and when.

    Raises:
        RecordingError: As `about`.
    """
    channels: set[int] = set()
    logs: set[int] = set()
    for record in _records(Path(path)):
        if isinstance(record, Schema) and record.name == LOG:
            logs.add(record.id)
        elif isinstance(record, Channel) and record.schema_id in logs:
            channels.add(record.id)
        elif isinstance(record, McapMessage) and record.channel_id in channels:
            yield json.loads(record.data)


def _listed(paths: Paths) -> list[Path]:
    """Each file once."""
    many = [paths] if isinstance(paths, str | Path) else paths
    return list(dict.fromkeys(Path(one) for one in many))


def _messages(path: Path, wanted: frozenset[str]) -> Iterator[Recorded]:
    forms: dict[int, Form] = {}
    channels: dict[int, tuple[str, Form]] = {}
    for record in _records(path):
        if isinstance(record, McapMessage):
            known = channels.get(record.channel_id)
            if known is None or (wanted and known[0] not in wanted):
                continue
            try:
                yield Recorded(known[0], record.log_time, known[1].read(record.data), known[1])
            except MessageError as error:
                raise RecordingError(f"'{path}' is damaged: {error}") from None
        elif isinstance(record, Schema) and record.name in _BY_TITLE:
            forms[record.id] = Form(_BY_TITLE[record.name], Catalogue.of_schema(json.loads(record.data)))
        elif isinstance(record, Channel) and record.schema_id in forms:
            channels[record.id] = (record.topic, forms[record.schema_id])


def _about(path: Path) -> About:
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
            raise RecordingError(f"'{path}' is a recording in format {own['format']}; this reads {FORMAT}.")
        return About(
            path=path,
            robot=own["robot"],
            recording=own["recording"],
            part=int(own["part"]),
            condition=own["condition"],
            described=json.loads(facts[ROBOT]["describe"]),
            losses={kind: int(lost.get(kind, 0)) for kind in KINDS},
            keys=_keys(listed if is_whole else _records(path)),
            begin_ns=begin_ns,
            end_ns=end_ns,
            is_whole=is_whole,
        )
    except (KeyError, ValueError):
        raise RecordingError(f"'{path}' is no recording that `gemuco record` wrote, or only its first bytes.") from None


def _keys(records: Iterable[object]) -> frozenset[str]:
    """The topics whose schema is one of ours."""
    ours: set[int] = set()
    found: set[str] = set()
    for record in records:
        if isinstance(record, Schema) and record.name in _BY_TITLE:
            ours.add(record.id)
        elif isinstance(record, Channel) and record.schema_id in ours:
            found.add(record.topic)
    return frozenset(found)


def _records(path: Path, whole_chunks: bool = False) -> Iterator[object]:
    """All records up to the end of the file, or up to where its writer was killed; a damaged chunk is left out."""
    try:
        stream = path.open("rb")
    except OSError as error:
        raise RecordingError(f"The recording '{path}' cannot be read: {error.strerror}.") from None
    begun = False
    with stream:
        records = StreamReader(stream, emit_chunks=True).records
        while True:
            try:
                record = next(records, None)
            except Exception as error:  # what a cut or damaged file makes mcap's reader raise
                if not begun:
                    said = str(error) or type(error).__name__
                    raise RecordingError(f"'{path}' is not a recording, or only its first bytes: {said}.") from None
                return
            if record is None:
                return
            begun = True
            if isinstance(record, Chunk) and not whole_chunks:
                yield from _unpacked(path, record)
            else:
                yield record


def _unpacked(path: Path, chunk: Chunk) -> list[Any]:
    try:
        return list(breakup_chunk(chunk, validate_crc=True))
    except Exception as error:  # of mcap, of zstd
        log.warning("'%s' is damaged; %d bytes are left out: %s", path, len(chunk.data), error)
        return []
