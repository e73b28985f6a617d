"""A process that is killed while it writes a file leaves the file before it or the new one, whole.

Every writer is killed before each of its lines in turn, and, as a long test, 100 times at random.
"""

import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.records import Message

from gemuco import checkpoint, writing
from gemuco.dataset import Dataset, Episode
from gemuco.errors import CheckpointError
from gemuco.layers import Layer, Weights
from gemuco.learning.draft import Draft
from gemuco.scaler import Scaler
from gemuco.schema import BodySchema
from gemuco.signals import Layout, Signal
from hal.calibration import store
from hal.config import RobotConfig
from services.learning.interruption import MARK, marked
from services.recording.file import RecordingFile
from services.recording.reading import _records
from services.security.init import init
from services.security.plan import InstallationPlan
from services.security.role_files import secrets_of

LAYOUT = Layout((Signal("angle", 2, "rad"), Signal("wire", 3, "m")))
ROOT = Path(writing.__file__).parents[1]
OURS = tuple(str(ROOT / name) for name in ("gemuco", "hal", "services"))
WRITING = {
    "save",
    "_keep",
    "replacing",
    "replace",
    "sync_folder",
    "_own",
    "_locked",
    "_replace",
    "marked",
    "write",
    "commit",
    "_commit",
}
"""Names of the functions that write; the lines of the others change nothing on the disk."""


def a_model(number: int) -> BodySchema:
    """A small model; the number is in its arrays and in its manifest."""
    weights = Weights(
        (Layer(np.full((7, 4), float(number)), np.zeros(4), "tanh"),), (Layer(np.ones((4, 5)), np.zeros(5), "linear"),)
    )
    scaler = Scaler(np.zeros(5), np.ones(5), -np.ones(5), np.ones(5), np.zeros(0, int))
    return BodySchema(
        LAYOUT, ("angle", "wire"), ("angle", "wire"), (frozenset({"wire"}),), scaler, weights, {}, np.zeros((0, 5)),
        np.zeros(0, int), None, np.zeros(0), {}, {"number": number},
    )  # fmt: skip


class SavedModel:
    def write(self, folder: Path, number: int) -> None:
        checkpoint.save(a_model(number), folder / "model")

    def read(self, folder: Path) -> int:
        model = checkpoint.load(folder / "model")
        assert (model.weights.encoder[0].matrix == model.manifest["number"]).all()
        kept = folder / "model" / checkpoint.KEPT
        if kept.exists():
            checkpoint._data(kept.parent, checkpoint._manifest(kept))
        return int(model.manifest["number"])


class SavedData:
    def write(self, folder: Path, number: int) -> None:
        values = {"angle": np.full((5, 2), float(number)), "wire": np.full((5, 3), float(number))}
        Dataset(LAYOUT, (Episode("", values),)).save(folder / "data.npz")

    def read(self, folder: Path) -> int:
        return int(Dataset.load(folder / "data.npz").rows()[-1, -1])


class SavedDraft:
    def write(self, folder: Path, number: int) -> None:
        Draft(folder / "training.safetensors", "key").save({"a": np.full(100, float(number))}, {"number": number})

    def read(self, folder: Path) -> int:
        loaded = Draft(folder / "training.safetensors", "key").load()
        assert loaded is not None
        return int(loaded[1]["number"])


class SavedMark:
    def write(self, folder: Path, number: int) -> None:
        def interrupted() -> None:
            with marked(folder, f"{number}"):
                raise InterruptedError

        with pytest.raises(InterruptedError):
            interrupted()

    def read(self, folder: Path) -> int:
        return int((folder / MARK).read_text())


class SavedCalibration:
    def _robot(self, folder: Path) -> RobotConfig:
        return RobotConfig.model_validate(
            {
                "robot": "arm", "folder": folder,
                "signals": {"joint_position": {"unit": "rad", "elements": ["elbow"]}},
                "command": {"signal": "joint_position"},
            }
        )  # fmt: skip

    def write(self, folder: Path, number: int) -> None:
        record = store.Record(
            device="elbow_drive", identity="x", settings={"zero": number}, measured_with={}, unit="rad", points=(),
            residual=0.0,
        )  # fmt: skip
        store.save(self._robot(folder), store.sealed(record))

    def read(self, folder: Path) -> int:
        path = store.path_of(self._robot(folder))
        kept = path.with_name(path.name + store.KEPT)
        assert not kept.exists() or yaml.safe_load(kept.read_text())["x"]
        return int(yaml.safe_load(path.read_text())["x"]["settings"]["zero"])


class SavedRoles:
    """Role files: the one step is each file; whatever is killed, the next `init` completes the folder."""

    def _plan(self, number: int) -> InstallationPlan:
        robots = {
            f"robot{n}": dict.fromkeys(("simulator", "hal", "vision", "model"), "127.0.0.1") for n in range(number)
        }
        return InstallationPlan.of(routers=["127.0.0.1"], robots=robots)

    def write(self, folder: Path, number: int) -> None:
        init(folder / "keys", self._plan(number))

    def read(self, folder: Path) -> int:
        for path in (folder / "keys").glob("*.json"):
            json.loads(path.read_text())
            if path.name != "plan.json":
                assert secrets_of(path).password
                assert path.stat().st_mode & 0o777 == 0o600
        plan = InstallationPlan.read(folder / "keys")
        return 0 if plan is None else len(plan.robots)


WRITERS = [SavedModel(), SavedData(), SavedDraft(), SavedMark(), SavedCalibration(), SavedRoles()]
"""All of them also begin where nothing is."""
QUICK = [writer for writer in WRITERS if not isinstance(writer, SavedRoles)]


def name_of(writer: object) -> str:
    return type(writer).__name__


def child(work: Callable[[], None]) -> int:
    """Do work in a process of its own and return its status; 0 if it was not killed."""
    pid = os.fork()
    if pid == 0:
        try:
            work()
            os._exit(0)
        except BaseException:
            sys.excepthook(*sys.exc_info())
            os._exit(1)
    return os.waitpid(pid, 0)[1]


def killed_at(line: int, work: Callable[[], None]) -> None:
    """Do work, and kill this process before a line of the functions that write."""
    seen = 0

    def trace(frame: Any, event: str, _: Any) -> Any:
        nonlocal seen
        code = frame.f_code
        if code.co_name not in WRITING or not code.co_filename.startswith(OURS):
            return None
        if event == "line":
            seen += 1
            if seen == line:
                os.kill(os.getpid(), signal.SIGKILL)
        return trace

    sys.settrace(trace)
    work()
    sys.settrace(None)


@pytest.mark.parametrize("writer", QUICK, ids=name_of)
@pytest.mark.long
def test_killed_at_any_line_a_writer_leaves_the_file_before_or_the_new_one(writer: Any, tmp_path: Path) -> None:
    writer.write(tmp_path, 1)
    number, line, seen = 1, 0, set()
    while True:
        line += 1
        status = child(partial(killed_at, line, partial(writer.write, tmp_path, number + 1)))
        found = writer.read(tmp_path)
        assert found in (number, number + 1), f"killed at line {line}"
        seen.add(found - number)
        number = found
        if status == 0:
            break
        assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
    assert line > 5 and seen == {0, 1}
    assert not [path.name for path in tmp_path.rglob("*.part")], "the next writer uses what a killed one left"


def test_a_model_killed_before_the_first_is_whole_is_no_model(tmp_path: Path) -> None:
    child(lambda: killed_at(40, lambda: checkpoint.save(a_model(1), tmp_path)))
    with pytest.raises(CheckpointError, match="There is no model"):
        checkpoint.load(tmp_path)
    checkpoint.save(a_model(2), tmp_path)
    assert checkpoint.load(tmp_path).manifest == {"number": 2}


@pytest.mark.long
def test_keys_killed_at_any_line_are_completed_by_the_next_init(tmp_path: Path) -> None:
    """From an empty folder, each time: the authority and its key, then each role file, then the plan."""
    folder, made, line = tmp_path, SavedRoles(), 1
    while True:
        own = folder / str(line)
        own.mkdir()
        status = child(partial(killed_at, line, partial(made.write, own, 1)))
        made.read(own)
        made.write(own, 1)
        assert made.read(own) == 1
        if status == 0:
            break
        line += 3


@pytest.mark.long
@pytest.mark.parametrize("writer", QUICK, ids=name_of)
def test_a_hundred_kills_at_random_times(writer: Any, tmp_path: Path) -> None:
    chance = random.Random(8)
    writer.write(tmp_path, 1)
    started = time.monotonic()
    child(lambda: [writer.write(tmp_path, number) for number in range(2, 7)])
    usual = (time.monotonic() - started) / 5
    last = writer.read(tmp_path)
    for _ in range(100):
        pid = os.fork()
        if pid == 0:
            while True:
                last += 1
                writer.write(tmp_path, last)
        time.sleep(chance.uniform(0.0, 10.0 * usual))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        found = writer.read(tmp_path)
        assert found >= last
        last = found
    assert last > 100  # writes were finished between the kills


@pytest.mark.long
def test_a_recording_killed_at_any_line_is_read_up_to_its_last_commit(tmp_path: Path) -> None:
    line, killed = 0, True
    while killed:
        line += 1
        path = tmp_path / f"{line}.mcap"
        reading, writing_end = os.pipe()

        def work(path: Path = path, end: int = writing_end) -> None:
            file = RecordingFile(path)
            channel = file.channel("arm/hal/sample", "json")
            for number in range(30):
                file.add(channel, number + 1, number + 1, number, b"{}")
                if number % 10 == 9:
                    file.commit()
                    os.write(end, b"x")

        killed = child(partial(killed_at, line, work)) != 0
        os.close(writing_end)
        commits = len(os.read(reading, 99))
        os.close(reading)
        read = sum(isinstance(record, Message) for record in _records(path)) if path.stat().st_size else 0
        assert read in (10 * commits, 10 * commits + 10)
    assert commits == 3 and read == 30 and line > 5


def test_bytes_are_on_the_disk_before_the_name_and_the_name_before_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def noted(handle: int) -> None:
        order.append(str(Path(f"/proc/self/fd/{handle}").readlink()).removeprefix(str(tmp_path)))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(Path, "replace", lambda one, other: (order.append("named"), replace(one, other))[1])
    writing.replace(tmp_path / "file", b"content")
    assert order == ["/file.part", "named", ""]
    SavedCalibration().write(tmp_path, 1)
    assert order[3:] == ["/arm.calibration.yaml.part", "named", ""]


def test_writers_of_one_file_wait_for_each_other(tmp_path: Path) -> None:
    pids = []
    for number in range(3):
        pid = os.fork()
        if pid == 0:
            for _ in range(10):
                checkpoint.save(a_model(number), tmp_path)
                checkpoint.load(tmp_path)
            os._exit(0)
        pids.append(pid)
    assert [os.waitpid(pid, 0)[1] for pid in pids] == [0, 0, 0]


def test_a_link_in_place_of_the_part_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("kept")
    for path in (tmp_path / "file", tmp_path / "arm.calibration.yaml"):
        path.with_name(path.name + ".part").symlink_to(victim)
    with pytest.raises(OSError, match="symbolic links"):
        writing.replace(tmp_path / "file", b"overwritten")
    with pytest.raises(store.ConfigError, match="cannot be saved"):
        SavedCalibration().write(tmp_path, 1)
    assert victim.read_text() == "kept"
