"""Recordings of a process that ends, of a full disk, and with damaged parts stay readable."""

import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from any_message import ARM
from recordings import eventually, log_lines, update_of, versions_of

from services.errors import RecordingError
from services.recording.reading import facts_of, losses
from services.recording.writer import Limits, RecordingWriter
from services.wire import keys, messages
from services.wire.records import Update
from services.wire.streams import Publisher

_RECORD = (
    "import sys; from services.recording.recorder import run_recorder; sys.exit(run_recorder(sys.argv[1], sys.argv[2]))"
)


@pytest.mark.long
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_recording_is_readable_however_its_process_ends(
    robot: str, session: zenoh.Session, tmp_path: Path, end: signal.Signals
) -> None:
    """After kill -9 only the newest part, at most a second, may be missing."""
    path = tmp_path / "run.mcap"
    updates = Publisher(session, keys.update(robot), Update, boot=3)
    process = subprocess.Popen([sys.executable, "-c", _RECORD, robot, str(path)])
    try:
        eventually(lambda: updates.has_listener)
        for version in range(150):
            updates.put(update_of(version))
        eventually(lambda: path.exists() and len(_try(lambda: versions_of(path))) == 150)
        process.send_signal(end)
        assert process.wait(20.0) == (-signal.SIGKILL if end is signal.SIGKILL else 0)
    finally:
        process.kill()
        process.wait()
    assert versions_of(path) == list(range(150))
    assert facts_of(path)[0].is_whole == (end is not signal.SIGKILL)


def _try(reading: Callable[[], list[int]]) -> list[int]:
    try:
        return reading()
    except RecordingError:  # nothing is safe yet
        return []


def test_a_full_disk_ends_the_file_and_a_new_one_begins_when_there_is_space(
    robot: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The least space that is left free is moved instead of the disk being filled."""
    free = shutil.disk_usage(tmp_path).free
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, robot, ARM, "", Limits(least_free=free // 4))
    writer.open(0)
    writer.add(keys.update(robot), 0, messages.encode(update_of(0), seq=0))
    writer._limits = Limits(least_free=2 * free)
    writer.commit(1)
    assert "Nothing is recorded: the disk of" in writer.failure and writer.failure in caplog.text
    assert facts_of(path)[0].is_whole and versions_of(path) == [0]
    for number in range(1, 5):
        writer.add(keys.update(robot), number, messages.encode(update_of(number), seq=number))
        writer.commit(number)
    assert writer.losses.totals()["dropped"] == 4
    writer._limits, writer._retry_at = Limits(least_free=free // 4), 0.0
    writer.add(keys.update(robot), 5, messages.encode(update_of(5), seq=5))
    writer.finish(6)
    assert writer.failure == ""
    assert versions_of(*writer.paths) == [0, 5]
    assert losses(writer.paths)["dropped"] == 4
    said = [line["message"] for line in log_lines(writer.paths[1])]
    assert any("Before this file: Nothing is recorded" in text for text in said)


def _limited(robot: str, folder: str) -> None:
    """In a process of its own: files may have 20 kB, as on a full disk; prints what is left of it."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    writer = RecordingWriter(Path(folder) / "run.mcap", robot, ARM, "", Limits())
    writer.open(0)
    for number in range(900):
        writer.add(keys.update(robot), number, messages.encode(update_of(number), seq=number, boot=number % 8 + 1))
        writer._retry_at = 0.0
        if number % 50 == 0:
            writer.commit(number)
    writer.finish(900)
    print(writer.written, writer.losses.totals()["dropped"])


def test_a_file_that_can_be_written_no_further_stays_readable(robot: str, tmp_path: Path) -> None:
    code = f"from test_recorder_faults import _limited; _limited({robot!r}, {str(tmp_path)!r})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True, timeout=60
    )
    written, dropped = map(int, done.stdout.split())
    assert written + dropped == 900 and written > 0 and dropped > 0, done.stderr
    assert "File too large" in done.stderr
    files = sorted(tmp_path.iterdir())
    assert len(files) > 1 and all(file.stat().st_size <= 20_000 for file in files)
    found = versions_of(*files)
    assert len(found) == written and found == sorted(set(found))


def test_a_damaged_part_is_left_out_and_the_rest_is_read(
    robot: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, robot, ARM)
    writer.open(0)
    sizes = []
    for number in range(30):
        writer.add(keys.update(robot), number + 1, messages.encode(update_of(number), seq=number))
        if number % 10 == 9:
            writer.commit(number + 1)
            sizes.append(writer.size)
    writer.finish(40)
    data = bytearray(path.read_bytes())
    middle = (sizes[0] + sizes[1]) // 2 - 60
    data[middle : middle + 8] = bytes(byte ^ 0xFF for byte in data[middle : middle + 8])
    path.write_bytes(data)
    assert versions_of(path) == [*range(10), *range(20, 30)]
    assert "is damaged" in caplog.text
    for length in range(0, len(data), 97):
        (tmp_path / "cut.mcap").write_bytes(data[:length])
        assert set(_try(lambda: versions_of(tmp_path / "cut.mcap"))) <= set(range(30))
