import contextlib
import json
import subprocess
import sys

import numpy as np
import pytest

from gemuco import checkpoint
from gemuco.anomaly.score import score
from gemuco.checkpoint import load, save
from gemuco.errors import CheckpointError, NotObservable, NotWritten
from gemuco.estimation import estimate
from gemuco.learning.draft import Draft


@pytest.fixture
def folder(schema, tmp_path):
    save(schema.with_manifest(robot="arm", hash="abc"), tmp_path / "model")
    return tmp_path / "model"


def test_comes_back_the_same(schema, arm, folder):
    again = load(folder)
    values = {name: array[0] for name, array in arm.sample(1, 3).items()}
    values.pop("joint_position")
    for name, found in estimate(schema, values).items():
        other = estimate(again, values)[name]
        np.testing.assert_array_equal(other.value, found.value)
        np.testing.assert_array_equal(other.std, found.std)
        assert (other.method, other.mask, other.residual) == (found.method, found.mask, found.residual)
    values = {name: array[0] for name, array in arm.sample(1, 3).items()}
    assert score(again, values).score == score(schema, values).score
    assert again.masks == schema.masks
    assert again.manifest == {"robot": "arm", "hash": "abc"}


def test_a_place_that_cannot_be_written_to_is_a_sentence(schema, data, tmp_path):
    file = tmp_path / "file"
    file.write_text("x")
    kept = {"a": np.zeros(3)}
    for what, write in (
        ("The model", lambda: save(schema, file / "model")),
        ("The model", lambda: save(schema, file)),
        ("The data", lambda: data.save(file / "data.npz")),
        ("The data", lambda: data.save(tmp_path)),
        ("The training", lambda: Draft(file / "training.safetensors", "key").save(kept, {})),
    ):
        with pytest.raises(NotWritten, match=f"{what} cannot be written to '.*': [A-Z].*name another place"):
            write()


def test_overwrites_what_was_there(schema, folder):
    save(schema.with_manifest(robot="other"), folder)
    assert load(folder).manifest == {"robot": "other"}
    assert len(list(folder.glob("model-*.safetensors"))) == 1  # the same arrays
    assert {path.name for path in folder.iterdir()} == {"manifest.json", "manifest.json.before", arrays(folder).name}


def arrays(folder):
    (path,) = folder.glob("model-*.safetensors")
    return path


def change(folder, **entries):
    path = folder / "manifest.json"
    head = json.loads(path.read_text())
    for key, value in entries.items():
        if value is None:
            del head[key]
        else:
            head[key] = value
    path.write_text(json.dumps(checkpoint.signed(head)))


def break_tensor(folder):
    data = bytearray(arrays(folder).read_bytes())
    data[-1] ^= 0xFF
    arrays(folder).write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (lambda f: (f / "manifest.json").unlink(), "There is no model in"),
        (lambda f: arrays(f).unlink(), "has no model-"),
        (lambda f: (f / "manifest.json").write_text("{"), "it is not JSON"),
        (lambda f: (f / "manifest.json").write_text("[" * 100000), "it is not JSON"),
        (lambda f: change(f, tensors={"file": "../model.safetensors", "sha256": "0"}), "in place of a file of arrays"),
        (lambda f: (f / "manifest.json").write_text("[]"), "does not describe a body schema but 'list'"),
        (lambda f: (f / "manifest.json").write_bytes(b"\xff\xfe\x00"), "is damaged"),
        (lambda f: change(f, format="dataset"), "does not describe a body schema but 'dataset'"),
        (lambda f: change(f, version=99), "has version 99; this gemuco reads 4: use a newer gemuco"),
        (lambda f: change(f, version=0), "has version 0; this gemuco reads 4: train it again"),
        (lambda f: change(f, masks=None), "is damaged"),
        (lambda f: change(f, masks=["wire"]), "is damaged"),
        (lambda f: change(f, x_out=["joint_position"]), "is damaged"),
        (lambda f: change(f, signals=[]), "is damaged"),
        (lambda f: change(f, normal=[]), "is damaged"),
        (lambda f: change(f, network={"encoder": ["tanh"] * 9, "decoder": ["linear"]}), "is damaged"),
        (break_tensor, "does not match its manifest"),
        (lambda f: arrays(f).write_bytes(b""), "does not match its manifest"),
    ],
)
def test_says_in_a_sentence_what_is_wrong(folder, damage, text):
    damage(folder)
    with pytest.raises(CheckpointError) as caught:
        load(folder)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(folder.name) in str(caught.value)


def test_the_service_side_never_loads_torch():
    modules = "schema, adaption.update, controller, simulation, search.losses, dataset, anomaly.score, checkpoint"
    imports = "; ".join(f"import gemuco.{name}" for name in modules.split(", "))
    code = f"import sys; {imports}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def usable(again, arm):
    """Everything that a service asks of a schema runs and stays finite."""
    values = {name: array[0] for name, array in arm.sample(1, 3).items()}
    values.pop("joint_position")
    for found in estimate(again, values).values():
        assert np.isfinite(found.value).all()
    for condition in again.biases:
        again.under(condition)
    score(again, values)


@pytest.mark.parametrize("pattern", ["manifest.json", "model-*.safetensors"])
def test_whatever_happens_to_a_byte_is_noticed_or_harmless(schema, arm, folder, pattern):
    (name,) = (path.name for path in folder.glob(pattern))
    random = np.random.default_rng(4)
    sound = (folder / name).read_bytes()
    noticed = 0
    for trial in range(150):
        data = bytearray(sound)
        kind = trial % 3
        where = int(random.integers(len(data)))
        if kind == 0:
            data[where] ^= 1 << int(random.integers(8))
        elif kind == 1:
            del data[where : where + int(random.integers(1, 40))]
        else:
            data[where:where] = random.bytes(int(random.integers(1, 20)))
        (folder / name).write_bytes(data)
        try:
            again = load(folder)
        except CheckpointError as error:
            noticed += 1
            assert "\n" not in str(error)
        else:
            usable(again, arm)
            assert again.layout == schema.layout
    assert noticed > 140


JUNK = [None, -1, 3, 0.5, "", "wire", "tanh", [], ["wire"], [["mask", "wire"]], {}, {"a": 1}, True]


def places(node, path=()):
    """Every place in a JSON value that can hold something else."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


def test_a_manifest_of_nonsense_is_noticed_or_harmless(arm, folder):
    path = folder / "manifest.json"
    sound = path.read_text()
    found = [place for place in places(json.loads(sound)) if place[0] not in ("facts", "sha256")]
    random = np.random.default_rng(5)
    for trial in range(300):
        head = json.loads(sound)
        place = found[trial % len(found)]
        node = head
        for key in place[:-1]:
            node = node[key]
        node[place[-1]] = JUNK[random.integers(len(JUNK))]
        path.write_text(json.dumps(checkpoint.signed(head)))
        try:
            again = load(folder)
        except CheckpointError as error:
            assert "\n" not in str(error)
        else:
            with contextlib.suppress(NotObservable):
                values = {name: value[0] for name, value in arm.sample(1, 3).items() if name in again.layout.names}
                estimate(again, values)
