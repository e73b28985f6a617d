import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from services import keys, messages
from services.errors import RecordingError
from services.messages import Update
from services.recorder import FLUSH_EVERY, Recorder, run_recorder
from services.recording import losses, read
from services.session import close_session, open_session
from services.streams import Publisher


def _update(version: int) -> Update:
    return Update(stamp_ns=version + 1, active=True, model_version=version, window=0, dropped=0, loss=0.0)


def _wait_for(recorder: Recorder, written: int) -> None:
    deadline = time.monotonic() + 20.0
    while recorder.written < written:
        assert time.monotonic() < deadline, recorder.counters()
        time.sleep(0.01)


def test_what_was_published_is_read_back_in_order(robot: str, tmp_path: Path) -> None:
    session = open_session(robot, "client")
    path = tmp_path / "new" / "run.mcap"
    with Recorder(session, robot, path) as recorder:
        updates = Publisher(session, keys.update(robot), Update, boot=3)
        for version in range(100):
            updates.put(_update(version))
        session.put(keys.sample(robot), b"no message of ours")
        _wait_for(recorder, 101)
    close_session(session)
    recorded = list(read(path))
    assert [entry.message.model_version for entry in recorded if isinstance(entry.message, Update)] == list(range(100))
    assert {entry.key for entry in recorded} == {keys.update(robot)}
    assert list(read(path, [keys.sample(robot)])) == []
    assert losses(path) == {"dropped": 0, "missed": 0}
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {channel.topic: channel.message_encoding for channel in summary.channels.values()} == {
        keys.update(robot): "msgpack",
        keys.sample(robot): "msgpack",
    }
    assert summary.statistics is not None
    assert summary.statistics.message_count == 101


class StalledDisk(Recorder):
    """A recorder whose disk stands still until the test lets it go on."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.stands = threading.Event()
        self.goes_on = threading.Event()

    def _add(self, key: str, received_ns: int, payload: bytes) -> None:
        self.stands.set()
        assert self.goes_on.wait(20.0)
        super()._add(key, received_ns, payload)


def test_losses_are_counted_and_written_into_the_file(robot: str, tmp_path: Path) -> None:
    session = open_session(robot, "client")
    path = tmp_path / "run.mcap"
    with StalledDisk(session, robot, path, depth=4) as recorder:
        session.put(keys.update(robot), messages.encode(_update(0), seq=0, boot=3))
        assert recorder.stands.wait(10.0)
        for seq in (1, 5, 6, 7, 8, 9):
            session.put(keys.update(robot), messages.encode(_update(seq), seq=seq, boot=3))
        deadline = time.monotonic() + 10.0
        while recorder.dropped < 2:
            assert time.monotonic() < deadline
            time.sleep(0.001)
        recorder.goes_on.set()
        _wait_for(recorder, 5)
        session.put(keys.update(robot), messages.encode(_update(0), seq=0, boot=4))
        _wait_for(recorder, 6)
    close_session(session)
    assert [entry.message.seq for entry in read(path)] == [0, 1, 5, 6, 7, 0]
    assert losses(path) == {"dropped": 2, "missed": 3}


def test_a_recording_never_replaces_a_file(robot: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    session = open_session(robot, "client")
    with pytest.raises(RecordingError, match="never replaces"):
        Recorder(session, robot, path).__enter__()
    close_session(session)
    told = threading.Event()
    told.set()
    for name in ("run-2.mcap", "run-3.mcap"):
        assert run_recorder(robot, path, stop=told) == 0
        assert losses(tmp_path / name) == {"dropped": 0, "missed": 0}
    assert path.read_text() == "precious"


def test_a_folder_that_cannot_be_written_is_told(robot: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written: "):
        run_recorder(robot, tmp_path / "file" / "run.mcap", stop=threading.Event())


def test_what_is_no_recording_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("a letter")
    with pytest.raises(RecordingError, match="is not a recording"):
        list(read(path))
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        list(read(tmp_path / "nowhere.mcap"))


_RECORD = "import sys; from services.recorder import run_recorder; sys.exit(run_recorder(sys.argv[1], sys.argv[2]))"


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_recording_is_readable_however_its_process_ends(robot: str, tmp_path: Path, end: signal.Signals) -> None:
    """After kill -9 only the newest part, not flushed yet, may be missing."""
    path = tmp_path / "run.mcap"
    session = open_session(robot, "hal")
    updates = Publisher(session, keys.update(robot), Update, boot=3)
    process = subprocess.Popen([sys.executable, "-c", _RECORD, robot, str(path)])
    try:
        deadline = time.monotonic() + 20.0
        while not updates.has_listener:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        for version in range(150):
            updates.put(_update(version))
            time.sleep(0.01)
        if end is signal.SIGKILL:
            time.sleep(2 * FLUSH_EVERY)
        process.send_signal(end)
        assert process.wait(20.0) == (-signal.SIGKILL if end is signal.SIGKILL else 0)
    finally:
        process.kill()
        process.wait()
        close_session(session)
    versions = [entry.message.model_version for entry in read(path) if isinstance(entry.message, Update)]
    assert versions == list(range(150))
    assert losses(path) == {"dropped": 0, "missed": 0}
