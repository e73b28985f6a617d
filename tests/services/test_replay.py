import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from any_message import ARM
from recorded_arm import a_sample, record
from typer.testing import CliRunner

from hal.errors import CommandRefused
from services.cli import app
from services.errors import AlreadyRunning, RecordingError
from services.process.lock import instead_of
from services.recording.reading import facts_of, read
from services.recording.recorder import recording
from services.recording.replay import run_replay
from services.recording.writer import Limits
from services.wire import keys, messages, query
from services.wire.records import Applied, Command, Sample, Status
from services.wire.session import close_session, open_session


@contextmanager
def _listening(robot: str) -> Iterator[dict[str, list[tuple[float, bytes]]]]:
    """What is published, by key, with its arrival [monotonic s]."""
    heard: dict[str, list[tuple[float, bytes]]] = {}
    session = open_session(robot, "client")

    def note(sample: Any) -> None:
        heard.setdefault(str(sample.key_expr), []).append((time.monotonic(), sample.payload.to_bytes()))

    session.declare_subscriber(keys.everything(robot), note)
    yield heard
    close_session(session)


@contextmanager
def _replaying(*arguments: Any, **more: Any) -> Iterator[threading.Event]:
    """A replay in a thread, which ended without error when the context ends."""
    stop, failed = threading.Event(), []

    def run() -> None:
        try:
            run_replay(*arguments, stop=stop, **more)
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield stop
    finally:
        stop.set()
        thread.join(30.0)
    assert not thread.is_alive() and not failed, failed


def _ask(session: Any, robot: str, verb: str, **arguments: Any) -> dict[str, Any]:
    return query.ask(session, keys.verb(robot, "hal", verb), arguments, timeout=20.0)


def _eventually(happened: Callable[[], Any], within: float = 30.0) -> None:
    deadline = time.monotonic() + within
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.long
def test_step_by_step_everything_comes_once_in_order_as_a_replay(robot: str, tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 60, limits=Limits(max_seconds=0.25))
    assert len(files) > 1
    with _listening(robot) as heard, _replaying(files[::-1], robot=robot, speed=0.0) as stop:
        session = open_session(robot, "client")
        _eventually(lambda: heard)  # a status: who listens is linked
        assert _ask(session, robot, "step", count=10)["samples"] == 10
        report = _ask(session, robot, "describe")
        assert report["signals"] == ARM.plain() and len(report["replay"]) == len(files) and report["robot"] == robot
        assert _ask(session, robot, "step", count=40)["samples"] == 50
        assert not stop.is_set()
        _ask(session, robot, "step", count=100)
        _eventually(stop.is_set)
        close_session(session)
    samples = [messages.decode(data, Sample) for _, data in heard[keys.sample(robot)]]
    assert [sample.cycle for sample in samples] == [sample.seq for sample in samples] == list(range(60))
    assert {sample.source for sample in samples} == {"replay"}
    assert len({sample.boot for sample in samples}) == 1 and samples[0].boot != 11
    now = time.time_ns()
    for sample in samples:
        assert now - 60 * 10**9 < sample.stamp_ns <= now
        np.testing.assert_array_equal(sample.values["joint_position"], a_sample(sample.cycle).values["joint_position"])
    applied = [messages.decode(data, Applied) for _, data in heard[keys.applied(robot)]]
    assert [one.cycle for one in applied] == list(range(60)) and {one.sender for one in applied} == {0}
    assert keys.command(robot) not in heard


@pytest.mark.slow
def test_twice_as_fast_takes_half_the_time_on_an_absolute_grid(robot: str, tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 600)
    with _listening(robot) as heard, _replaying(files, robot=robot, speed=2.0) as stop:
        _eventually(stop.is_set)
    statuses = [messages.decode(data, Status) for _, data in heard[keys.status(robot, "hal")]]
    playing = [status for status in statuses if status.state == "running"]  # the first may come before anybody listens
    assert playing[-1].facts["replay"]["files"] == ["run.mcap"] and "A replay at 2 x" in playing[-1].text
    assert statuses[-1].state == "stopping"
    samples = [(when, messages.decode(data, Sample)) for when, data in heard[keys.sample(robot)]]
    assert len(samples) >= 500  # the first ones may be published before anybody listens
    took = samples[-1][0] - samples[0][0]
    assert took > 0.9 * (samples[-1][1].cycle - samples[0][1].cycle) / 200
    stamps = [sample.stamp_ns for _, sample in samples]
    assert np.allclose(np.diff(stamps), 5e6, atol=1e3)


@pytest.mark.slow
def test_a_replay_is_paused_stepped_and_goes_on_from_another_place(robot: str, tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 600, limits=Limits(max_seconds=0.7))
    assert len(files) > 2

    def cycles() -> list[int]:
        return [messages.decode(data, Sample).cycle for _, data in heard.get(keys.sample(robot), ())]

    with _listening(robot) as heard, _replaying(files, robot=robot, speed=0.0) as stop:
        session = open_session(robot, "client")
        _eventually(lambda: heard)
        assert _ask(session, robot, "step", count=3)["samples"] == 3
        report = _ask(session, robot, "seek", to=2.0)
        assert report["paused"] and report["samples"] > 3  # the other place is shown
        assert abs(report["position"] - 2.0) < 0.2
        _ask(session, robot, "step", count=2)
        _ask(session, robot, "seek", to=0.5)
        shown = _ask(session, robot, "pause")["samples"]
        _eventually(lambda: len(cycles()) == shown)
        back = int(np.argmin(np.diff(cycles()))) + 1  # the first sample of the second jump
        late, early = cycles()[3:back], cycles()[back:]
        assert cycles()[:3] == [0, 1, 2] and late == list(range(late[0], late[-1] + 1))
        assert early == list(range(early[0], early[-1] + 1))
        assert abs(late[-3] - 4 * early[-1]) < 20 and early[-1] > 20
        assert not _ask(session, robot, "play")["paused"]
        _eventually(lambda: len(cycles()) > 20)
        assert _ask(session, robot, "pause")["paused"]
        count = _ask(session, robot, "pause")["samples"]
        time.sleep(0.3)
        assert _ask(session, robot, "pause")["samples"] == count and not stop.is_set()
        statuses = [messages.decode(data, Status) for _, data in heard[keys.status(robot, "hal")]]
        assert statuses[-1].facts["replay"]["paused"] is True and "paused" in statuses[-1].text
        for wrong in ({}, {"to": -1.0}, {"to": 1e6}, {"to": "end"}, {"to": True}):
            with pytest.raises(Exception, match="seek takes"):
                _ask(session, robot, "seek", **wrong)
        _ask(session, robot, "seek", to=2.5)
        _ask(session, robot, "play")
        _eventually(stop.is_set)
        close_session(session)
    assert cycles()[back:] == sorted(cycles()[back:]) and cycles()[-1] == 599
    stamps = [messages.decode(data, Sample).stamp_ns for _, data in heard[keys.sample(robot)]]
    assert stamps == sorted(stamps)  # or clients would take them as late


@pytest.mark.long
def test_what_was_restarted_looks_restarted_again(robot: str, tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 20, make=lambda number: a_sample(number, boot=11 + (number >= 10)))
    with _listening(robot) as heard, _replaying(files, robot=robot, speed=0.0) as stop:
        session = open_session(robot, "client")
        _eventually(lambda: heard)
        _ask(session, robot, "step", count=30)
        _eventually(stop.is_set)
        close_session(session)
    boots = [messages.decode(data, Sample).boot for _, data in heard[keys.sample(robot)]]
    assert len(set(boots[:10])) == len(set(boots[10:])) == 1 and boots[0] != boots[10]
    assert not {11, 12} & set(boots)


@pytest.mark.long
def test_long_pauses_are_cut(robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = record(tmp_path / "a.mcap", "arm", 5) + record(tmp_path / "b.mcap", "arm", 5, begin=100 * 3600)
    began = time.monotonic()
    assert run_replay(files, robot=robot, stop=threading.Event()) == 0
    assert 1.0 < time.monotonic() - began < 30.0
    assert "20 messages" in (said := capsys.readouterr().out) and "1 long pauses were cut to 1 s" in said


def test_what_moves_is_refused_and_steps_are_checked(robot: str, tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 10)
    with _replaying(files, robot=robot, speed=0.0):
        session = open_session(robot, "client")
        for verb in ("enable", "home", "tare", "reset", "lease", "disable", "stop", "estop"):
            with pytest.raises(CommandRefused, match=f"it has no motors and cannot '{verb}'"):
                _ask(session, robot, verb)
        for wrong in (0, -1, "one", True, 10**9):
            with pytest.raises(Exception, match="step takes"):
                _ask(session, robot, "step", count=wrong)
        close_session(session)


def test_a_replay_is_refused_where_a_hal_runs_and_what_cannot_be_played_is_told(robot: str, tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", robot, 10)
    with instead_of(robot, "hal"), pytest.raises(AlreadyRunning, match="already has a 'hal' service"):
        run_replay(files, stop=threading.Event())
    other = record(tmp_path / "other.mcap", "other", 10)
    with pytest.raises(RecordingError, match="several robots: other"):
        run_replay(files + other, stop=threading.Event())
    for speed in (-1.0, float("nan"), float("inf")):
        with pytest.raises(RecordingError, match="cannot be played at"):
            run_replay(files, speed=speed, stop=threading.Event())
    with pytest.raises(RecordingError, match="No such file"):
        run_replay([tmp_path / "nowhere.mcap"], stop=threading.Event())
    session = open_session(robot, "hal")
    with recording(session, robot, tmp_path / "empty.mcap", ARM) as recorder:
        session.put(keys.command(robot), messages.encode(Command(signal="a", values=np.ones(1), cycle=1, hal_boot=1)))
        _eventually(lambda: recorder.writer.losses.malformed or recorder.writer.written)
    close_session(session)
    with pytest.raises(RecordingError, match="There are no messages of robot"):
        run_replay(tmp_path / "empty.mcap", stop=threading.Event())


@pytest.mark.long
def test_a_cut_file_is_played_up_to_where_its_writer_was_killed(robot: str, tmp_path: Path) -> None:
    (file,) = record(tmp_path / "run.mcap", "arm", 200)
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    assert not facts_of(file)[0].is_whole
    count = len(list(read(file, [keys.sample("arm")])))
    assert 0 < count < 200
    with _listening(robot) as heard, _replaying(file, robot=robot, speed=0.0) as stop:
        session = open_session(robot, "client")
        _eventually(lambda: heard)
        _ask(session, robot, "step", count=300)
        _eventually(stop.is_set)
        close_session(session)
    assert len(heard[keys.sample(robot)]) == count


def test_the_verbs_end_in_a_sentence(tmp_path: Path) -> None:
    (file,) = record(tmp_path / "run.mcap", "arm", 10)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:40])
    for words, said in (
        (["replay", str(tmp_path / "none.mcap")], "cannot be read"),
        (["replay", str(cut)], "only its first bytes"),
        (["export", str(cut), "--out", str(tmp_path / "out")], "only its first bytes"),
        (["record", "arm", str(tmp_path / "run.bag")], "ends in .mcap"),
        (["train", "musashi_arm", "--data", str(file)], "recordings of 'arm'"),
    ):
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 1 and said in done.stderr and "Traceback" not in done.output, done.output
