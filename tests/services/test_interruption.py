"""A training that was interrupted is reported as interrupted, and no other is."""

import numpy as np
import pytest
from typer.testing import CliRunner

from gemuco import as_dataset
from gemuco.errors import NotEnoughData
from services.cli import app
from services.learning.interruption import key_of_training, marked

DATA = as_dataset({"q": np.arange(6.0), "f": np.ones(6)}, {"q": "rad", "f": "N"})
TEXT = """
recording: rig
episodes: '*.csv'
signals: {q: {unit: rad, columns: q}, f: {unit: N, columns: f}}
network: {hidden: [8], latent: 2}
structure: {epochs: 2, threshold_out: THRESHOLD, threshold_in: 1.0}
training: {epochs: 2}
"""


def run(folder, key, error=None):
    """Return whether a training was interrupted before; it ends with an error, if one is given."""
    with marked(folder, key) as was_interrupted:
        if error is not None:
            raise error
    return was_interrupted


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError()])
def test_an_interrupted_training_is_known_until_it_ends(tmp_path, error):
    with pytest.raises(type(error)):
        run(tmp_path / "model.draft", "one", error)
    assert not run(tmp_path / "another.draft", "one")
    assert run(tmp_path / "model.draft", "one")
    assert not run(tmp_path / "model.draft", "one")


def test_a_refused_training_was_not_interrupted(tmp_path):
    with pytest.raises(NotEnoughData):
        run(tmp_path, "one", NotEnoughData("no signal"))
    assert not run(tmp_path, "one")


def test_an_interrupted_training_of_other_data_is_not_continued(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, key_of_training(DATA, 0), KeyboardInterrupt())
    assert not run(tmp_path, key_of_training(DATA, 1))


@pytest.mark.long
def test_the_command_line_reports_only_an_interruption(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    q, f = np.random.default_rng(0).normal(size=(2, 200))
    (tmp_path / "a.csv").write_text("q,f\n" + "\n".join(f"{a},{b}" for a, b in zip(q, f, strict=True)) + "\n1.0")
    rig = tmp_path / "rig.yaml"
    rig.write_text(TEXT.replace("THRESHOLD", "0.0001"))
    runner, words = CliRunner(), ["train", "rig.yaml"]
    for _ in range(2):  # refused twice, or trained twice with what there is
        done = runner.invoke(app, words)
        assert "interrupted" not in done.output
        assert "'a.csv': the last line was cut off and is left out (line 202: has 1 column; the header has 2)" in (
            " ".join(done.output.split())
        )
