"""Read a recording back, also one whose writer was killed."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader

from services import messages
from services.errors import RecordingError
from services.messages import Message, MessageError
from services.recorder import METADATA


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording.

    Attributes:
        key: On which key it was published.
        received_ns: When the recorder received it [ns since 1970, the recorder's wall clock].
        message: What was published.
    """

    key: str
    received_ns: int
    message: Message


def read(path: str | Path, wanted: Iterable[str] = ()) -> Iterator[Recorded]:
    """The messages of a recording in the order of their arrival; what is no message of ours is left out.

    Args:
        path: A file that `Recorder` wrote, finished or not.
        wanted: Keys to read; all if none is given.

    Raises:
        RecordingError: There is no such file, or it is not a recording.
    """
    keys = set(wanted)
    channels: dict[int, str] = {}
    for record in _records(Path(path)):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, McapMessage):
            key = channels[record.channel_id]
            if keys and key not in keys:
                continue
            message = _decoded(record.data)
            if message is not None:
                yield Recorded(key, record.log_time, message)


def losses(path: str | Path) -> dict[str, int]:
    """How many messages are missing from a recording: `dropped` by the recorder, `missed` on the way to it.

    Raises:
        RecordingError: There is no such file, or it is not a recording.
    """
    last = {"dropped": "0", "missed": "0"}
    for record in _records(Path(path)):
        if isinstance(record, Metadata) and record.name == METADATA:
            last = record.metadata
    return {name: int(last[name]) for name in ("dropped", "missed")}


def _records(path: Path) -> Iterator[object]:
    """All records up to the end of the file, or up to where its writer was killed."""
    try:
        stream = path.open("rb")
    except OSError as error:
        raise RecordingError(f"The recording '{path}' cannot be read: {error.strerror}.") from None
    begun = False
    with stream:
        try:
            for record in StreamReader(stream).records:
                begun = True
                yield record
        except (McapError, EOFError, ValueError) as error:
            if not begun:
                raise RecordingError(f"'{path}' is not a recording: {error or type(error).__name__}.") from None


def _decoded(data: bytes) -> Message | None:
    try:
        return messages.decode_any(data)
    except MessageError:
        return None
