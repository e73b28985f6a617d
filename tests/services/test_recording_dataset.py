import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from any_message import ARM
from recorded_arm import BEGIN, SECOND, a_sample, position, record

from gemuco.errors import DatasetError
from hal.config import RobotConfig
from services.recording.dataset import select
from services.recording.writer import Limits, RecordingWriter
from services.verbs.train import run_training
from services.wire import keys, messages
from services.wire.records import Sample


def _robot(name: str = "arm", **more: Any) -> RobotConfig:
    """The robot file of the recorded arm; collect.rate is 20 Hz."""
    description: dict[str, Any] = {
        "robot": name,
        "signals": {
            "joint_position": {"unit": "rad", "elements": ["elbow", "wrist"]},
            "muscle_tension": {"unit": "N", "elements": ["biceps"]},
        },
        "command": {"signal": "muscle_tension", "time_to_live": 0.1, "hold": 0.5},
        "limits": {"joint_position": {"low": -0.55, "high": 0.55}},
    }
    return RobotConfig.model_validate(description | more)


def test_samples_are_taken_at_the_rate_of_collecting_in_episodes(tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 1200, "loaded", Limits(max_seconds=7.0))
    found = select(_robot(), files[::-1])
    rows = found.dataset.rows()
    assert found.seen == len(rows) == 240  # 12 s at 20 Hz
    assert [len(episode.values["joint_position"]) for episode in found.dataset.episodes] == [200, 40]
    assert found.dataset.conditions == ("loaded",)
    np.testing.assert_array_equal(rows[:, :2], [position(5 * number) for number in range(240)])
    assert found.sentence() == "240 of 240 samples are used."
    assert select(_robot(), files, "empty").dataset.conditions == ("empty",)
    kept, away = found.dataset.split(0.2)
    assert 216 <= len(kept) + len(away) < 240  # without the gaps beside held-out blocks


def test_what_is_incomplete_invalid_or_beyond_limits_is_left_out_and_told(tmp_path: Path) -> None:
    def make(number: int) -> Sample:
        sample = a_sample(number, complete=number % 100 != 0)
        if number % 100 == 20:
            sample.values["joint_position"][1] = math.nan
            sample.valid["joint_position"][1] = False
        if number % 100 == 40:
            sample.values["joint_position"][1] = 0.7
        if number % 100 == 60:
            sample.age["joint_position"][:] = 0.5
        return sample

    found = select(_robot(), record(tmp_path / "run.mcap", "arm", 500, make=make))
    assert found.sentence() == (
        "80 of 100 samples are used; 5 were incomplete, in 15 a value was not measured or beyond its limits (most "
        "often joint_position.wrist, 10)."
    )
    assert np.isfinite(found.dataset.rows()).all()


def test_pauses_and_restarts_begin_a_new_episode(tmp_path: Path) -> None:
    files = record(tmp_path / "a.mcap", "arm", 100) + record(tmp_path / "b.mcap", "arm", 100, begin=1000)
    files += record(tmp_path / "c.mcap", "arm", 200, begin=2000, make=lambda n: a_sample(n, boot=11 + (n >= 2100)))
    found = select(_robot(), files)
    assert [len(episode.values["muscle_tension"]) for episode in found.dataset.episodes] == [20, 20, 20, 20]


def test_what_a_camera_saw_is_merged_by_age_and_may_be_missing(tmp_path: Path) -> None:
    robot = _robot(
        signals={
            "joint_position": {"unit": "rad", "elements": ["elbow", "wrist"]},
            "muscle_tension": {"unit": "N", "elements": ["biceps"], "source": "vision", "stale_after": 0.1},
        },
        command={"signal": "joint_position", "time_to_live": 0.1, "hold": 0.5},
    )
    writer = RecordingWriter(tmp_path / "run.mcap", "arm", ARM)
    writer.open(0)
    for number in range(200):
        sample = a_sample(number)
        parts = [
            Sample(
                stamp_ns=sample.stamp_ns,
                seq=number,
                cycle=number,
                source="can",
                complete=True,
                **{field: {name: getattr(sample, field)[name]} for field in ("values", "age", "valid")},
            )
            for name in ("joint_position", "muscle_tension")
        ]
        writer.add(keys.sample("arm"), sample.stamp_ns, messages.encode(parts[0]))
        if number < 100 and number % 3 == 0:
            writer.add(keys.vision("arm"), sample.stamp_ns, messages.encode(parts[1]))
    writer.finish(BEGIN + 3 * SECOND)
    rows = select(robot, writer.paths).dataset.rows()
    assert len(rows) == 40
    assert np.isfinite(rows[1:20, 2]).all() and np.isnan(rows[23:, 2]).all()


def test_data_that_do_not_fit_are_one_sentence(tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 100)
    with pytest.raises(DatasetError, match="recordings of 'arm', but the robot file is of 'leg'"):
        select(_robot("leg"), files)
    with pytest.raises(DatasetError, match="Give it with --condition; the robot file has duster, none"):
        select(_robot(conditions=["duster", "none"]), files)
    signals = {
        "joint_position": {"unit": "m", "elements": ["elbow", "wrist"]},
        "muscle_tension": {"unit": "N", "elements": ["biceps"]},
    }
    with pytest.raises(DatasetError, match=r"elbow, wrist \[rad\]; elbow, wrist \[m\] are expected"):
        select(_robot(signals=signals), files)
    with pytest.raises(DatasetError, match="'elbow_temperature' is not in"):
        more = {
            "elbow_temperature": {"unit": "degC", "elements": ["elbow"]},
            "muscle_tension": signals["muscle_tension"],
        }
        select(
            _robot(signals=more, command={"signal": "muscle_tension", "time_to_live": 0.1, "hold": 0.5}, limits={}),
            files,
        )
    still = record(tmp_path / "bad.mcap", "arm", 100, make=lambda number: a_sample(number, complete=False))
    with pytest.raises(DatasetError, match="These recordings hold no sample to train from: 0 of 20 samples"):
        select(_robot(), still)


def test_train_takes_recordings_and_tells_what_it_cannot_take(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = record(tmp_path / "run.mcap", "arm", 1000)
    file = tmp_path / "arm.yaml"
    file.write_text(_robot().model_dump_json(include={"robot", "signals", "command", "limits"}, exclude_none=True))
    small = {
        "network": {"hidden": [8, 4], "latent": 2},
        "structure": {"epochs": 2, "threshold_in": 1.0, "threshold_out": 1.0},
        "training": {"epochs": 2},
    }
    text = file.read_text().rstrip()
    file.write_text(f'{text[:-1]}, "model": {str(small).replace(chr(39), chr(34))}}}')
    run_training(file, files, tmp_path / "model", None, 0)
    assert "200 of 200 samples are used." in capsys.readouterr().out
    assert (tmp_path / "model").is_dir()
    for data, condition, said in (
        ([files[0], tmp_path / "data.npz"], None, "not from both at once"),
        ([tmp_path / "a.npz", tmp_path / "b.npz"], None, "can be several files"),
        ([tmp_path / "a.npz"], "heavy", "is for recordings"),
    ):
        with pytest.raises(DatasetError, match=said):
            run_training(file, data, tmp_path / "model", None, 0, condition)
