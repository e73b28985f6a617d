import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest
import zenoh
from any_message import ARM, a_message
from mcap.reader import make_reader
from recordings import eventually, log_lines, record_as, update_of, versions_of

from services.errors import RecordingError
from services.process.service import Service
from services.recording import recorder
from services.recording.losses import LOG, MOST_KEYS, OTHERS, Losses
from services.recording.reading import facts_of, losses, read
from services.recording.recorder import EntryQueue, Recorder, run_recorder
from services.recording.writer import UNREADABLE, Limits, RecordingWriter
from services.wire import keys, messages
from services.wire.records import Holder, Sample, Update
from services.wire.session import close_session, open_session
from services.wire.streams import Publisher


def test_what_was_published_is_read_back_in_order(robot: str, session: zenoh.Session, tmp_path: Path) -> None:
    path = tmp_path / "new" / "run.mcap"
    sample = a_message(Sample)
    with record_as(session, robot, path) as found:
        updates = Publisher(session, keys.update(robot), Update, boot=3)
        for version in range(100):
            updates.put(update_of(version))
        session.put(keys.sample(robot), messages.encode(sample))
        eventually(lambda: found.writer.written == 101)
    assert versions_of(path) == list(range(100))
    (again,) = read(path, [keys.sample(robot)])
    assert messages.encode(again.message) == messages.encode(sample)
    assert losses(path) == {"dropped": 0, "missed": 0, "malformed": 0}
    (facts,) = facts_of(path)
    assert (facts.robot, facts.condition, facts.part, facts.is_whole) == (robot, "a tool", 1, True)
    assert facts.catalogue == ARM


def test_any_tool_that_reads_mcap_finds_json_that_fits_its_schema(
    robot: str, session: zenoh.Session, tmp_path: Path
) -> None:
    """The plain mcap library and a JSON Schema validator; nothing of ours."""
    path = tmp_path / "run.mcap"
    with record_as(session, robot, path) as found:
        for record, key in ((Sample, keys.sample(robot)), (Update, keys.update(robot)), (Holder, keys.holder(robot))):
            session.put(key, messages.encode(a_message(record)))
        eventually(lambda: found.writer.written == 3)
    seen = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None and (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            jsonschema.validate(msgspec.json.decode(message.data), msgspec.json.decode(schema.data))
            seen[channel.topic] = schema.name
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count >= 4
    log = keys.robot_key(robot, "recorder", "log")
    assert seen == {
        keys.sample(robot): "gemuco.Sample", keys.update(robot): "gemuco.Update", keys.holder(robot): "gemuco.Holder",
        log: LOG,
    }  # fmt: skip


def test_unknown_keys_and_bytes_that_are_no_message_are_kept_and_counted(
    robot: str, session: zenoh.Session, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    with record_as(session, robot, path) as found:
        session.put(keys.robot_key(robot, "gripper", "note"), b'{"grip": 1}', encoding="application/json")
        session.put(keys.robot_key(robot, "gripper", "image"), b"\x89PNG", encoding="image/png")
        session.put(keys.sample(robot), b"no message of ours")
        session.put(keys.update(robot), messages.encode(a_message(Sample)))
        eventually(lambda: found.writer.written == 4)
        assert found.counters()["foreign"] == 2
    kept = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema is None:
                kept[channel.topic.rpartition(f"{robot}/")[2]] = channel.message_encoding, message.data[:8]
    assert kept == {
        "gripper/note": ("json", b'{"grip":'), "gripper/image": ("image/png", b"\x89PNG"),
        f"hal/sample{UNREADABLE}": ("msgpack", b"no messa"),
        f"model/update{UNREADABLE}": ("msgpack", messages.encode(a_message(Sample))[:8]),
    }  # fmt: skip
    assert losses(path)["malformed"] == 2
    assert [line["key"] for line in log_lines(path) if line["kind"] == "malformed"] == [
        keys.sample(robot),
        keys.update(robot),
    ]
    assert list(read(path)) == []


@pytest.mark.long
def test_who_comes_goes_and_commands_is_in_the_log(robot: str, session: zenoh.Session, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with record_as(session, robot, path) as found:
        token = session.liveliness().declare_token(keys.alive(robot, "model"))
        eventually(lambda: found.writer.size)
        for name in ("anna", "anna", "", "ben"):
            session.put(keys.holder(robot), messages.encode(Holder(name=name, holder=1)))
        eventually(lambda: found.writer.written == 4)
        token.undeclare()
        eventually(lambda: [line for line in log_lines(path) if line["kind"] == "gone"])
    said = [line["message"] for line in log_lines(path) if line["kind"] in ("alive", "gone", "holder")]
    assert said == [
        "The 'model' service started.", "anna commands the robot.", "No client commands the robot.",
        "ben commands the robot.", "The 'model' service ended.",
    ]  # fmt: skip


def test_the_hal_tells_what_elements_are_called(robot: str, tmp_path: Path) -> None:
    report = {"signals": ARM.plain(), "rates": {"hal": 200.0}}
    path = tmp_path / "run.mcap"
    with Service(robot, "hal", describe=lambda: report) as hal:
        client = open_session(robot, "recorder")
        with recorder.recording(client, robot, path) as found:
            samples = Publisher(hal.session, keys.sample(robot), Sample, 1)
            eventually(lambda: samples.has_listener)
            sample = a_message(Sample)
            assert isinstance(sample, Sample)
            samples.put(sample)
            eventually(lambda: found.writer.written >= 1)
        close_session(client)
    (facts,) = facts_of(path)
    assert facts.described["rates"] == {"hal": 200.0}
    assert not {"pid", "host"} & facts.described.keys()
    (one,) = read(path, [keys.sample(robot)])
    assert one.form.catalogue == ARM


@pytest.mark.long
def test_without_anybody_who_names_them_elements_have_numbers(
    robot: str, session: zenoh.Session, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    with recorder.recording(session, robot, path) as found:
        session.put(keys.sample(robot), messages.encode(a_message(Sample)))
        eventually(lambda: found.writer.written == 1)
    (one,) = read(path, [keys.sample(robot)])
    assert one.form.catalogue.signals["joint_position"].elements == ("element_1", "element_2")


class StalledDisk(RecordingWriter):
    """A writer whose disk stands still until the test lets it go on."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.stands = threading.Event()
        self.goes_on = threading.Event()

    def add(self, key: str, received_ns: int, payload: bytes, encoding: str = "") -> None:
        self.stands.set()
        assert self.goes_on.wait(30.0)
        super().add(key, received_ns, payload, encoding)


def test_losses_are_counted_and_written_into_the_file(robot: str, session: zenoh.Session, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = StalledDisk(path, robot, ARM)
    with Recorder(session, robot, writer, limit=4) as found:
        session.put(keys.update(robot), messages.encode(update_of(0), seq=0, boot=3))
        assert writer.stands.wait(20.0)
        for seq in (1, 5, 6, 7, 8, 9):
            session.put(keys.update(robot), messages.encode(update_of(seq), seq=seq, boot=3))
        writer.goes_on.set()
        eventually(lambda: writer.written == 5)
        session.put(keys.update(robot), messages.encode(update_of(0), seq=0, boot=4))
        eventually(lambda: writer.written == 6)
    assert [entry.message.seq for entry in read(path)] == [0, 1, 5, 6, 7, 0]
    assert losses(path) == {"dropped": 2, "missed": 3, "malformed": 0}
    report = {line["kind"]: (line["key"], line["count"]) for line in log_lines(path) if "count" in line}
    assert report == {"dropped": (keys.update(robot), 2), "missed": (keys.update(robot), 3)}
    assert recorder.missing(found.counters()) == ("Of the messages, 2 could not be written, 3 never arrived here.")


def test_senders_of_one_key_are_counted_apart() -> None:
    counted = RecordingWriter(Path("never.mcap"), "arm", ARM).losses
    for seq in range(5):
        counted.arrived("a", 1, seq)
        counted.arrived("a", 2, 2 * seq)
    assert counted.totals()["missed"] == 4


def test_what_waits_is_bounded_in_number_and_bytes() -> None:
    waiting = EntryQueue(limit=3, limit_bytes=100)
    for size in (60, 60, 30, 5, 5):
        waiting.put(recorder.Entry("message", "key", 0, bytes(size)))
    items, dropped = waiting.take()
    assert [len(item.payload) for item in items] == [60, 30, 5]
    assert dropped == {"key": 2}
    for number in range(10):
        waiting.put(recorder.Entry("message", f"key {number}", 0, bytes(101)))
    assert len(waiting.take()[1]) == 4  # no more names than messages are remembered


def test_a_new_file_begins_when_one_is_big_or_long_and_nothing_is_lost_or_doubled(robot: str, tmp_path: Path) -> None:
    second = 10**9
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, robot, ARM, "", Limits(max_seconds=2.0))
    writer.open(0)
    for number in range(100):
        now = number * second // 10
        writer.add(keys.update(robot), now, messages.encode(update_of(number), seq=number))
        if number % 7 == 0:
            writer.commit(now)
    writer.finish(10 * second)
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == [f"run-00000{number}.mcap" for number in range(1, 6)]
    assert [len(versions_of(file)) for file in files] == [20] * 5
    assert versions_of(*reversed(files)) == list(range(100))
    assert losses(files)["missed"] == 0
    assert [facts.part for facts in facts_of(files)] == [1, 2, 3, 4, 5]
    again = RecordingWriter(path, robot, ARM, "", Limits(max_bytes=4000))
    again.open(0)
    for number in range(200):
        again.add(keys.update(robot), number, messages.encode(update_of(number), seq=number, boot=number % 50))
        again.commit(number)
    again.finish(200)
    assert again.paths[0].name == "run-000006.mcap"
    assert len(again.paths) > 2 and versions_of(*again.paths) == list(range(200))
    assert all(file.stat().st_size >= 4000 for file in again.paths[:-1])


def test_what_is_counted_as_dropped_has_no_more_names_than_are_kept() -> None:
    counted = Losses()
    for number in range(2 * MOST_KEYS):
        counted.drop(f"key {number}", 2)
    assert len(counted.dropped) == MOST_KEYS + 1
    assert counted.totals()["dropped"] == 4 * MOST_KEYS
    assert counted.dropped[OTHERS] == 2 * MOST_KEYS


def test_a_recording_without_limits_begins_a_new_file_every_hour(robot: str, tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", robot, ARM)
    writer.open(0)
    for number in range(3):
        writer.add(keys.update(robot), number * 1800 * 10**9, messages.encode(update_of(number), seq=number))
    writer.finish(3600 * 10**9)
    assert [path.name for path in writer.paths] == ["run.mcap", "run-000002.mcap"]
    assert versions_of(*writer.paths) == [0, 1, 2]


@pytest.mark.long
def test_a_recording_never_replaces_a_file(robot: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    report = threading.Event()
    report.set()
    for name in ("run-000002.mcap", "run-000003.mcap"):
        assert run_recorder(robot, path, stop=report) == 0
        assert losses(tmp_path / name) == {"dropped": 0, "missed": 0, "malformed": 0}
    assert path.read_text() == "precious"


def test_a_recording_of_a_silent_robot_says_so(robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stop = threading.Event()
    threading.Timer(1.5, stop.set).start()  # one status of the recorder itself is recorded
    assert run_recorder(robot, tmp_path / "run.mcap", stop=stop) == 0
    text = capsys.readouterr().out
    assert f"No message of robot '{robot}' has arrived" in text
    assert "Nothing is missing" not in text


def test_a_file_that_cannot_be_written_is_told(robot: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written: "):
        run_recorder(robot, tmp_path / "file" / "run.mcap", stop=threading.Event())
    with pytest.raises(RecordingError, match=r"ends in \.mcap"):
        run_recorder(robot, tmp_path / "run.bag", stop=threading.Event())


def test_what_is_no_recording_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("a letter")
    with pytest.raises(RecordingError, match="is not a recording"):
        list(read(path))
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        list(read(tmp_path / "nowhere.mcap"))
    with pytest.raises(RecordingError, match="No recording was named"):
        list(read([]))


@pytest.mark.long
def test_nothing_secret_is_in_a_recording(robot: str, tmp_path: Path) -> None:
    role = tmp_path / "role.json"
    role.write_text('{"transport": {"auth": {"usrpwd": {"user": "recorder", "password": "open sesame"}}}}')
    path = tmp_path / "run.mcap"
    code = (
        "import sys, threading\nfrom services.recording.recorder import run_recorder\nstop = threading.Event()\n"
        f"threading.Timer(1.5, stop.set).start()\nrun_recorder({robot!r}, {str(path)!r}, [{str(role)!r}], stop)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60, env={**os.environ, "SECRET": "open sesame"})
    with path.open("rb") as stream:
        reader = make_reader(stream)
        found = b"".join(message.data for _, _, message in reader.iter_messages())
        found += b"".join(str(facts.metadata).encode() for facts in reader.iter_metadata())
    assert b'"service":"recorder"' in found
    for secret in (b"open sesame", b"usrpwd", b"role.json"):
        assert secret not in found and secret not in path.read_bytes()
