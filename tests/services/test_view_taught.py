"""Samples that a person records become a dataset that training reads."""

import threading
from pathlib import Path

import numpy as np
import pytest
from talking_robot import DESCRIBED, sample

from gemuco.dataset import Dataset
from gemuco.signals import Layout, Signal
from services.view.taught import NotRecorded, TaughtFile, posture
from services.watch.snapshot import Newest, RobotSnapshot
from services.wire.messages import Sample


def seen(silent: bool = False, age: float = 0.01) -> RobotSnapshot:
    return RobotSnapshot(robot="arm", hal=DESCRIBED, sample=Newest(sample(silent), age))


def record(file: TaughtFile, condition: str) -> int:
    return file.add(condition, *posture(seen()))


def test_training_reads_what_was_taught(tmp_path: Path):
    file = TaughtFile(tmp_path / "runs" / "taught.npz")
    counts = [record(file, name) for name in ("light", "light", "heavy", "heavy", " light ")]
    assert counts == [1, 2, 3, 4, 5]
    dataset = Dataset.load(file.path)
    assert dataset.conditions == ("light", "heavy")
    assert [len(dataset.layout.join(one.values)) for one in dataset.episodes] == [2, 2, 1]
    train, held_out = dataset.split(0.2)
    assert len(train) + len(held_out) == 5
    assert dataset.layout.signal("joint_position").elements == ("shoulder", "elbow")


def test_a_file_that_is_there_grows(tmp_path: Path):
    record(TaughtFile(tmp_path / "taught.npz"), "light")
    again = TaughtFile(tmp_path / "taught.npz")
    assert record(again, "light") == 2
    assert [one.condition for one in Dataset.load(again.path).episodes] == ["light", "light"]


def test_what_is_not_measured_is_not_recorded(tmp_path: Path):
    with pytest.raises(NotRecorded, match=r"joint_position \(elbow\) is not measured"):
        posture(seen(silent=True))
    with pytest.raises(NotRecorded, match="not measured now"):
        posture(seen(age=2.0))
    with pytest.raises(NotRecorded, match="has not described its signals"):
        posture(RobotSnapshot(robot="arm"))


def test_a_value_that_is_no_number_is_refused(tmp_path: Path):
    layout, values = posture(seen())
    values["muscle_tension"] = np.array([np.inf])
    with pytest.raises(NotRecorded, match=r"muscle_tension\.biceps is not a number"):
        TaughtFile(tmp_path / "taught.npz").add("light", layout, values)
    assert not (tmp_path / "taught.npz").exists()


@pytest.mark.parametrize("name", ["", "   ", "x" * 61, "a\nb"])
def test_a_condition_needs_a_name(tmp_path: Path, name: str):
    with pytest.raises(NotRecorded, match="needs a name"):
        record(TaughtFile(tmp_path / "taught.npz"), name)


def test_the_last_one_can_be_taken_back_and_no_more(tmp_path: Path):
    record(TaughtFile(tmp_path / "taught.npz"), "before")
    file = TaughtFile(tmp_path / "taught.npz")
    record(file, "light")
    record(file, "light")
    assert (file.undo(), file.undo()) == (2, 1)
    with pytest.raises(NotRecorded, match="nothing to take back"):
        file.undo()
    assert Dataset.load(file.path).conditions == ("before",)
    assert record(file, "light") == 2


def test_somebody_elses_sample_is_not_taken_back(tmp_path: Path):
    file, other = TaughtFile(tmp_path / "taught.npz"), TaughtFile(tmp_path / "taught.npz")
    record(file, "light")
    moved = Sample(**{name: getattr(sample(), name) for name in ("cycle", "source", "complete", "age", "valid")},
                   values={"joint_position": np.array([0.9, 0.9]), "muscle_tension": np.array([1.0])})  # fmt: skip
    other.add("light", *posture(RobotSnapshot(robot="arm", hal=DESCRIBED, sample=Newest(moved, 0.0))))
    with pytest.raises(NotRecorded, match="another process"):
        file.undo()
    assert len(Dataset.load(file.path)) == 2


def test_a_file_of_another_robot_is_left_alone(tmp_path: Path):
    path = tmp_path / "taught.npz"
    TaughtFile(path).add("x", Layout((Signal("other", 1, "m"),)), {"other": np.array([1.0])})
    before = path.read_bytes()
    with pytest.raises(NotRecorded, match="holds other signals"):
        record(TaughtFile(path), "light")
    path.write_bytes(b"not a dataset")
    with pytest.raises(Exception, match="not a readable dataset"):
        record(TaughtFile(path), "light")
    assert path.read_bytes() == b"not a dataset"
    assert before


def _record_many(path: Path) -> None:
    file = TaughtFile(path)
    for _ in range(5):
        record(file, "light")


def test_two_pages_that_record_lose_nothing(tmp_path: Path):
    path = tmp_path / "taught.npz"
    pages = [threading.Thread(target=_record_many, args=(path,)) for _ in range(2)]
    for page in pages:
        page.start()
    for page in pages:
        page.join()
    assert len(Dataset.load(path)) == 10
