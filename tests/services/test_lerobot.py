"""Datasets of LeRobot: recordings exported with their marks, datasets read back, the plugin on a stand-in."""

import importlib
import json
import math
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_arm import ARM, BEGIN, SECOND, a_sample, record
from ros_listener import eventually
from talking_robot import TalkingRobot

from gemuco.errors import DatasetError
from services.errors import RecordingError
from services.lerobot.export import export_lerobot
from services.lerobot.layout import statistics
from services.measured.episode_files import read_recording
from services.recording.reading import read
from services.recording.writer import RecordingWriter
from services.wire import keys, messages
from services.wire.records import Estimates, Sample

parquet = pytest.importorskip("pyarrow.parquet", reason="the extra `parquet` is not installed")


PLUGIN = Path(__file__).parents[2] / "integrations" / "lerobot"
JOINTS = [f"joint_position.{element}" for element in ARM.signals["joint_position"].elements]


def with_estimates(path: Path, count: int, lost: range) -> Path:
    """Write samples of 100 Hz and estimates; the second joint is not measured in a range of them."""
    writer = RecordingWriter(path, "arm", ARM)
    writer.open(BEGIN)
    for number in range(count):
        whole, is_lost = a_sample(number), number in lost
        angles = whole.values["joint_position"].copy()
        guess = angles + np.array([0.0, 0.01])
        if is_lost:
            angles[1] = np.nan
        sample = Sample(
            stamp_ns=whole.stamp_ns, seq=number, boot=11, cycle=number, source="can", complete=not is_lost,
            values={"joint_position": angles, "muscle_tension": whole.values["muscle_tension"]}, age=whole.age,
            valid={"joint_position": np.array([True, not is_lost]), "muscle_tension": np.ones(1, bool)},
        )  # fmt: skip
        estimates = Estimates(
            cycle=number, stamp_ns=whole.stamp_ns, seq=number, boot=12,
            values={"joint_position": guess if is_lost else angles, "muscle_tension": whole.values["muscle_tension"]},
            estimated={"joint_position": np.array([False, is_lost]), "muscle_tension": np.array([False])},
            std={"joint_position": np.array([0.0, 0.02 * is_lost]), "muscle_tension": np.zeros(1)},
            method={"joint_position": "mask" if is_lost else "measured", "muscle_tension": "measured"},
            mask={"joint_position": "muscle_tension" if is_lost else "", "muscle_tension": ""},
            residual={"joint_position": 0.0, "muscle_tension": 0.0},
        )  # fmt: skip
        writer.add(keys.sample("arm"), sample.stamp_ns + 200_000, messages.encode(sample))
        writer.add(keys.estimate("arm"), sample.stamp_ns + 300_000, messages.encode(estimates))
    writer.finish(BEGIN + count * SECOND // 100)
    return path


def test_a_dataset_has_the_values_of_the_recording_and_its_marks(tmp_path: Path) -> None:
    recording = with_estimates(tmp_path / "walk.mcap", 400, range(150, 250))
    exported = export_lerobot([recording], tmp_path / "set", rate=25, task="wave")
    assert exported.episodes == 1 and 90 <= exported.frames <= 100
    rows = parquet.read_table(tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet").to_pylist()
    about = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    names = about["features"]["observation.state"]["names"]
    assert names == JOINTS
    every = about["features"]["observation.estimated"]["names"]
    marks = [row["observation.estimated"][every.index(JOINTS[1])] for row in rows]
    assert 20 <= sum(marks) <= 27, "a second of four was estimated"
    true = {round(a_sample(n).values["joint_position"][1], 5) for n in range(400)}
    for row, mark in zip(rows, marks, strict=True):
        value = row["observation.state"][1]
        std = row["observation.std"][every.index(JOINTS[1])]
        assert round(value - 0.01 * mark, 5) in true
        assert std == pytest.approx(0.02 if mark else 0.0)
        assert row["timestamp"] == pytest.approx(row["frame_index"] / 25, abs=1e-6)
    assert [row["index"] for row in rows] == list(range(len(rows)))
    assert about["total_frames"] == len(rows) and about["fps"] == 25 and about["robot_type"] == "arm"
    listed = tmp_path / "set" / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    (episode,) = parquet.read_table(listed).to_pylist()
    assert (episode["dataset_from_index"], episode["dataset_to_index"]) == (0, len(rows))
    assert episode["tasks"] == ["wave"]
    states = np.array([row["observation.state"] for row in rows])
    np.testing.assert_allclose(episode["stats/observation.state/mean"], states.mean(axis=0), atol=1e-6)
    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    np.testing.assert_allclose(stats["observation.state"]["max"], states.max(axis=0), atol=1e-6)
    with pytest.raises(RecordingError, match="exists and is not replaced"):
        export_lerobot([recording], tmp_path / "set")


def test_where_nothing_is_known_there_is_no_frame(tmp_path: Path) -> None:
    files = [*record(tmp_path / "a.mcap", "arm", 300), *record(tmp_path / "b.mcap", "arm", 300, begin=900)]
    exported = export_lerobot(files, tmp_path / "set", rate=20)
    assert exported.episodes == 2
    rows = parquet.read_table(tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet").to_pylist()
    for number in range(2):
        own = [row for row in rows if row["episode_index"] == number]
        assert [row["frame_index"] for row in own] == list(range(len(own)))
        assert all(np.isfinite(row["observation.state"]).all() for row in own)
    assert "action" in rows[0]
    silent = with_estimates(tmp_path / "silent.mcap", 50, range(50))
    with pytest.raises(RecordingError, match="No moment of these recordings has a value of every element"):
        export_lerobot([silent], tmp_path / "none", rate=100)
    assert not (tmp_path / "none").exists()
    assert not [path for path in tmp_path.iterdir() if "part" in path.name], "nothing half-written stays"


def test_statistics_are_those_of_numpy() -> None:
    values = np.random.default_rng(3).normal(size=(50, 2)).astype(np.float32)
    stats = statistics(values)
    assert stats["count"] == [50]
    np.testing.assert_allclose(stats["q10"], np.quantile(values.astype(float), 0.1, axis=0))
    np.testing.assert_allclose(stats["std"], values.astype(float).std(axis=0))


def test_what_was_estimated_is_not_learned_as_measured(tmp_path: Path) -> None:
    recording = with_estimates(tmp_path / "walk.mcap", 400, range(150, 250))
    export_lerobot([recording], tmp_path / "set", rate=25)
    read_back = read_recording([tmp_path / "set"])
    labels = {column.label for column in read_back.columns}
    assert "observation.state_1" in labels
    assert not labels & {"frame_index", "index", "observation.estimated_1", "observation.std_1"}
    lost = next(column for column in read_back.columns if column.label == "observation.state_1")
    kept = next(column for column in read_back.columns if column.label == "observation.state_0")
    assert np.isnan(lost.values).sum() >= 20
    assert not np.isnan(kept.values).any()
    assert len(list(read([recording]))) == 800, "the recording itself has everything"


@pytest.mark.parametrize(
    ("information", "message"),
    [
        ('{"codebase_version": "v2.1"}', "in version v2.1; v3.0 is read"),
        ('{"codebase_version": "v3.0"}', "has no file data/chunk-"),
        ("{no json", "cannot be read"),
    ],
)
def test_a_dataset_that_cannot_be_read_is_refused_in_a_sentence(tmp_path: Path, information: str, message: str) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(information)
    with pytest.raises(DatasetError, match=message):
        read_recording([tmp_path])


@pytest.mark.long
def test_the_verbs_export_and_describe(tmp_path: Path) -> None:
    with_estimates(tmp_path / "walk.mcap", 300, range(0))
    answer = gemuco(tmp_path, "export", "walk.mcap", "--out", "set", "--format", "lerobot", "--fps", "25")
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.startswith("1 episodes with ")
    answer = gemuco(tmp_path, "describe", "set")
    assert answer.returncode == 0, answer.stderr
    assert "observation.state_{0..1}" in (tmp_path / "set.yaml").read_text()


def gemuco(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "services.cli", *words], cwd=folder, capture_output=True, text=True, timeout=100,
        check=False, env={"PYTHONPATH": str(PLUGIN.parents[1]), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The plugin on a stand-in of the few parts of LeRobot that it uses; `make test-lerobot` has the real one."""

    class Config:
        @staticmethod
        def register_subclass(_: str) -> Any:
            return lambda kind: kind

    class Robot:
        def __init__(self, config: Any) -> None:
            self.id = "stand-in"

    class Step:
        pass

    class Registry:
        @staticmethod
        def register(_: str) -> Any:
            return lambda kind: kind

    parts: dict[str, dict[str, Any]] = {
        "lerobot": {}, "lerobot.robots": {}, "lerobot.utils": {},
        "lerobot.robots.config": {"RobotConfig": Config}, "lerobot.robots.robot": {"Robot": Robot},
        "lerobot.utils.errors": {
            "DeviceNotConnectedError": type("DeviceNotConnectedError", (ConnectionError,), {}),
            "DeviceAlreadyConnectedError": type("DeviceAlreadyConnectedError", (ConnectionError,), {}),
        },
        "lerobot.processor": {"ObservationProcessorStep": Step, "ProcessorStepRegistry": Registry},
    }  # fmt: skip
    for name, contents in parts.items():
        module = types.ModuleType(name)
        module.__dict__.update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(PLUGIN))
    yield importlib.import_module("lerobot_robot_gemuco")
    for name in [name for name in sys.modules if name.startswith("lerobot_robot_gemuco")]:
        del sys.modules[name]


@pytest.mark.long
def test_the_plugin_marks_what_is_estimated_and_returns_nothing_old(robot: str, plugin: Any) -> None:
    with TalkingRobot(robot) as talking:
        arm = plugin.Gemuco(plugin.GemucoConfig(robot=robot, moves=False, timeout=20.0))
        assert arm.observation_features["joint_position.elbow.estimated"] is float
        assert list(arm.action_features) == ["joint_position.shoulder", "joint_position.elbow"]
        arm.connect()
        now = arm.get_observation()
        assert set(now) == set(arm.observation_features)
        assert (now["joint_position.elbow"], now["joint_position.elbow.estimated"]) == (-0.5, 0.0)
        talking.silent = True
        eventually(lambda: arm.get_observation()["joint_position.elbow.estimated"] == 1.0)
        now = arm.get_observation()
        assert (now["joint_position.elbow"], now["joint_position.elbow.std"]) == (-0.48, 0.02)
        talking.end("model")
        with pytest.raises(ConnectionError, match=r"No fresh message of the model|'model' service"):
            eventually(lambda: arm.get_observation() and False)
        arm.disconnect()
        with pytest.raises(ConnectionError, match="not connected"):
            arm.get_observation()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ({"joint_position.shoulder": 0.1}, "missing or unknown here: joint_position.elbow"),
        ({"joint_position.shoulder": 0.1, "joint_position.elbow": math.nan}, "elbow is not a finite number"),
        (
            {"joint_position.shoulder": 0.1, "joint_position.elbow": 0.0, "gripper": 1.0},
            "missing or unknown here: gripper",
        ),
    ],
)
def test_a_bad_action_sends_nothing(robot: str, plugin: Any, action: dict[str, float], message: str) -> None:
    with TalkingRobot(robot):
        arm = plugin.Gemuco(plugin.GemucoConfig(robot=robot, timeout=20.0))
        arm._wait_for_motors = lambda client: None
        arm.connect()
        sent: list[Any] = []
        arm._client.command = lambda *words: sent.append(words)
        with pytest.raises(ValueError, match=message):
            arm.send_action(action)
        assert not sent
        with pytest.raises(ConnectionError, match="mode of its motors is 'off'"):
            arm.send_action({"joint_position.shoulder": 3.0, "joint_position.elbow": 0.0})
        assert sent[0][1].tolist() == [1.0, 0.0], "the limits of the robot file hold"
        arm.disconnect()


def test_a_robot_without_services_is_not_connected(robot: str, plugin: Any) -> None:
    arm = plugin.Gemuco(plugin.GemucoConfig(robot=robot, timeout=0.5))
    with pytest.raises(ConnectionError, match=r"No .*service|does not answer|Is .*running"):
        arm.connect()
    assert not arm.is_connected


def test_the_step_marks_or_refuses_what_is_unknown(plugin: Any) -> None:
    step = plugin.UnknownProcessorStep()
    assert step.observation({"a.x": 1.0, "a.unknown": 0.0})["observation.unknown"] == 0.0
    assert step.observation({"a.unknown": 0.0, "b.unknown": 1.0})["observation.unknown"] == 1.0
    with pytest.raises(ValueError, match="estimate of b is outside"):
        plugin.UnknownProcessorStep(refuse=True).observation({"a.unknown": 0.0, "b.unknown": 1.0})
    with pytest.raises(ValueError, match="no `SIGNAL"):
        step.observation({"a.x": 1.0})
