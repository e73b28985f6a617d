"""Recordings of an update per version: how they are made and read back."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import zenoh
from any_message import ARM
from mcap.records import Channel
from mcap.records import Message as McapMessage

from services.recording import recorder
from services.recording.reading import _records, read
from services.recording.recorder import Recorder
from services.recording.writer import Limits
from services.wire.records import Update


def update_of(version: int) -> Update:
    return Update(stamp_ns=version + 1, active=True, model_version=version, window=0, dropped=0, loss=0.0)


def log_lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of the log in a file that may still be written."""
    records = list(_records(path))
    logs = {record.id for record in records if isinstance(record, Channel) and record.topic.endswith("/recorder/log")}
    return [
        msgspec.json.decode(record.data)
        for record in records
        if isinstance(record, McapMessage) and record.channel_id in logs
    ]


def eventually(happened: Callable[[], Any], within: float = 30.0) -> None:
    deadline = time.monotonic() + within
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@contextmanager
def record_as(session: zenoh.Session, robot: str, path: Path, limits: Limits | None = None) -> Iterator[Recorder]:
    with recorder.recording(session, robot, path, ARM, "a tool", limits) as found:
        yield found


def versions_of(*paths: Path) -> list[int]:
    return [one.message.model_version for one in read(paths) if isinstance(one.message, Update)]
