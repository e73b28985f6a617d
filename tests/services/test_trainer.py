"""From data to a model, as `gemuco train` does it: told plainly, drawn, and going on after an interruption."""

from dataclasses import replace

import numpy as np
import pytest
from arm_model import arm, states
from rich.console import Console

from gemuco.anomaly.prediction import predict_error
from gemuco.dataset import Dataset, Episode
from gemuco.errors import DatasetError, NotWritten
from gemuco.learning.history import History
from gemuco.signals import Layout
from services.learning import trainer
from services.model.living_model import layout_of

SMALL = {
    "network": {"hidden": [20], "latent": 8},
    "structure": {"threshold_out": 1.0, "threshold_in": 1.0, "epochs": 8},
    "training": {"epochs": 8, "batch": 200, "rate": 0.01},
}


@pytest.fixture(scope="module")
def robot():
    return arm().model_copy(update={"model": SMALL})


@pytest.fixture(scope="module")
def dataset(robot):
    rows = states()
    parts = np.split(np.arange(1500), 6)
    return Dataset(
        layout_of(robot), tuple(Episode("", {name: value[part] for name, value in rows.items()}) for part in parts)
    )


def quiet(_done, _text):
    """Tell nobody."""


@pytest.fixture(scope="module")
def straight(robot, dataset):
    return trainer.train(robot, dataset, 0, quiet)


@pytest.mark.parametrize("share", [0.3, 0.8])
@pytest.mark.slow
def test_goes_on_after_an_interruption(robot, dataset, straight, tmp_path, share):
    folder = tmp_path / "model"

    def interrupt(done, _text):
        if done > share:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer.train(robot, dataset, 0, interrupt, trainer.drafts_of(folder))
    assert list(trainer.drafts_of(folder).iterdir())
    again = trainer.train(robot, dataset, 0, quiet, trainer.drafts_of(folder))
    assert again.structure.L_i == straight.structure.L_i
    assert again.history.held_out == straight.history.held_out
    for one, other in zip(again.schema.weights.arrays(), straight.schema.weights.arrays(), strict=True):
        np.testing.assert_array_equal(one, other)
    trainer.save(again, folder)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model"]
    names = {path.name for path in folder.iterdir()}
    (arrays,) = names - {"manifest.json", "structure.png", "training.png"}
    assert arrays.startswith("model-")
    assert (folder / "training.png").read_bytes().startswith(b"\x89PNG")
    console = Console(record=True, width=120)
    trainer.show(again, console)
    assert ("continued at epoch" in console.export_text()) == (share > 0.5)


def test_data_in_another_unit_are_refused(robot, dataset):
    signals = tuple(replace(s, unit="deg") if s.name == "joint_position" else s for s in dataset.layout.signals)
    other = Dataset(Layout(signals), dataset.episodes)
    with pytest.raises(DatasetError) as caught:
        trainer.train(robot, other, 0, quiet)
    assert "'joint_position' is in deg in the data, but must be in rad" in str(caught.value)
    assert "gemuco collect" in str(caught.value)


def test_a_file_where_the_model_shall_be_is_told_before_training(tmp_path):
    (tmp_path / "model").write_text("x")
    with pytest.raises(NotWritten, match="a model needs a folder"):
        trainer.drafts_of(tmp_path / "model")


def test_what_a_person_should_know_is_said():
    history = History((1.0,), (1.0,), 1.0, 0, 3, 5, ("arm.elbow",), ("All data are of one condition.",))
    said = " ".join(trainer.remarks(history))
    for part in ("one condition", "arm.elbow", "3 training samples were skipped", "5 measured signals"):
        assert part in said
    assert trainer.remarks(History((1.0,), (1.0,), 1.0, 0)) == []


@pytest.mark.slow
def test_a_model_is_fine_tuned_on_few_samples_of_another_body(robot, dataset, straight, tmp_path):
    longer = {name: values + (0.03 if name == "muscle_length" else 0.0) for name, values in states(count=300).items()}
    parts = np.split(np.arange(300), 6)
    few = Dataset(
        layout_of(robot), tuple(Episode("", {name: value[part] for name, value in longer.items()}) for part in parts)
    )
    patient = robot.model_copy(update={"model": SMALL | {"training": {"epochs": 60, "batch": 50, "rate": 0.01}}})
    tuned = trainer.train(patient, few, 0, quiet, base=straight.schema)
    assert tuned.structure is None
    assert tuned.schema.masks == straight.schema.masks

    def wrong(schema):
        return float(np.abs(predict_error(schema, longer)[:, schema.out_layout.slice("muscle_length")]).mean())

    assert wrong(tuned.schema) < 0.7 * wrong(straight.schema)
    trainer.save(tuned, tmp_path / "model")
    assert not (tmp_path / "model" / "structure.png").exists()
