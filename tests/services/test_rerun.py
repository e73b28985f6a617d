"""The robot in rerun: entities of a file as rerun itself reads them, and a live viewer that comes and goes.

Run by `make test-rerun`: rerun-sdk has half a gigabyte, so it is no part of the tests' environment.
"""

import socket
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("rerun", reason="the extra `rerun` is not installed: `make test-rerun`")

import rerun as rr
from recorded_arm import ARM, record
from rerun.chunk import RrdReader
from talking_robot import seen
from test_foxglove import URDF

from services.errors import RecordingError
from services.rerun.file import write_rerun
from services.rerun.live import run_rerun
from services.rerun.picture import RobotPicture
from services.watch.frames import Frames


@pytest.fixture
def frames(tmp_path: Path) -> Frames:
    (tmp_path / "two.urdf").write_text(URDF)
    return Frames(tmp_path / "two.urdf")


def chunks(path: Path) -> dict[str, list]:
    """Return entity -> its chunks."""
    entities: dict[str, list] = {}
    for chunk in RrdReader(str(path)).stream():
        entities.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
    return entities


def values(path: Path, entity: str) -> list[float]:
    """Return the scalars of an entity in the order of time."""
    pairs = []
    for batch in chunks(path).get(entity, ()):
        names = batch.schema.names
        if "Scalars:scalars" in names:
            times = batch.column(names.index("time")).cast("int64").to_pylist()
            pairs += zip(times, batch.column(names.index("Scalars:scalars")).to_pylist(), strict=True)
    return [cell[0] for _, cell in sorted(pairs)]


def picture(path: Path, frames: Frames) -> tuple[RobotPicture, rr.RecordingStream]:
    stream = rr.RecordingStream("test")
    stream.save(path)
    return RobotPicture("arm", stream, frames), stream


def test_measured_and_estimated_are_different_series(tmp_path: Path, frames: Frames) -> None:
    path = tmp_path / "arm.rrd"
    shown, stream = picture(path, frames)
    shown.show(seen(), 10**18)
    shown.show(seen(silent=True), 10**18 + 10**8)
    shown.show(seen(age=3.0), 10**18 + 2 * 10**8)
    stream.disconnect()
    entities = chunks(path)
    assert len(values(path, "/arm/joint_position/shoulder/measured")) == 2
    assert len(values(path, "/arm/joint_position/elbow/measured")) == 1
    assert len(values(path, "/arm/joint_position/elbow/estimated")) == 1
    low, high = (values(path, f"/arm/joint_position/elbow/{end}")[0] for end in ("low", "high"))
    assert low < values(path, "/arm/joint_position/elbow/estimated")[0] < high
    assert {"/arm/robot/upper/rod", "/arm/robot/lower/joint", "/arm/log", "/arm/health"} <= set(entities)


def test_a_recording_has_every_moment_and_replaces_no_file(tmp_path: Path, frames: Frames) -> None:
    recording = record(tmp_path / "walk.mcap", "arm", 300)
    path, count = write_rerun(recording, tmp_path / "out", frames)
    assert path.name == "walk.rrd" and 80 <= count <= 100
    name = ARM.signals["joint_position"].elements[1]
    assert len(values(path, f"/arm/joint_position/{name}/measured")) >= 80
    with pytest.raises(RecordingError, match=r"walk.rrd' exists and is not replaced"):
        write_rerun(recording, tmp_path / "out", frames)
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["walk.rrd"]


def test_a_viewer_that_is_not_there_delays_nothing_and_the_end_comes_at_once() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    stop = threading.Event()
    viewer = f"rerun+http://127.0.0.1:{port}/proxy"
    thread = threading.Thread(
        target=run_rerun, args=("nobody_is_here", {"joint_position": "rad"}, viewer), kwargs={"stop": stop}, daemon=True
    )
    thread.start()
    time.sleep(1.0)
    stop.set()
    thread.join(15.0)
    assert not thread.is_alive()
