import json
import subprocess
import sys

import numpy as np
import pytest

from gemuco.errors import CheckpointError
from gemuco.schema import BodySchema


@pytest.fixture
def folder(schema, tmp_path):
    schema.with_manifest(robot="arm", hash="abc").save(tmp_path / "model")
    return tmp_path / "model"


def test_comes_back_the_same(schema, arm, folder):
    again = BodySchema.load(folder)
    values = {name: array[0] for name, array in arm.sample(1, 3).items()}
    values.pop("joint_position")
    for name, found in schema.estimate(values).items():
        other = again.estimate(values)[name]
        np.testing.assert_array_equal(other.value, found.value)
        np.testing.assert_array_equal(other.std, found.std)
        assert (other.method, other.mask, other.residual) == (found.method, found.mask, found.residual)
    values = {name: array[0] for name, array in arm.sample(1, 3).items()}
    assert again.anomaly(values).score == schema.anomaly(values).score
    assert again.masks == schema.masks
    assert again.manifest == {"robot": "arm", "hash": "abc"}


def test_overwrites_what_was_there(schema, folder):
    schema.with_manifest(robot="other").save(folder)
    assert BodySchema.load(folder).manifest == {"robot": "other"}
    assert sorted(path.name for path in folder.iterdir()) == ["manifest.json", "model.safetensors"]


def change(folder, **entries):
    path = folder / "manifest.json"
    head = json.loads(path.read_text())
    for key, value in entries.items():
        if value is None:
            del head[key]
        else:
            head[key] = value
    path.write_text(json.dumps(head))


def break_tensor(folder):
    data = bytearray((folder / "model.safetensors").read_bytes())
    data[-1] ^= 0xFF
    (folder / "model.safetensors").write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (lambda f: (f / "manifest.json").unlink(), "There is no model in"),
        (lambda f: (f / "model.safetensors").unlink(), "has no model.safetensors"),
        (lambda f: (f / "manifest.json").write_text("{"), "it is not JSON"),
        (lambda f: (f / "manifest.json").write_text("[]"), "does not describe a body schema but 'list'"),
        (lambda f: (f / "manifest.json").write_bytes(b"\xff\xfe\x00"), "is damaged"),
        (lambda f: change(f, format="dataset"), "does not describe a body schema but 'dataset'"),
        (lambda f: change(f, version=99), "has version 99; this gemuco reads 2: use a newer gemuco"),
        (lambda f: change(f, version=0), "has version 0; this gemuco reads 2: train it again"),
        (lambda f: change(f, masks=None), "is damaged"),
        (lambda f: change(f, masks=["wire"]), "is damaged"),
        (lambda f: change(f, x_out=["joint_position"]), "is damaged"),
        (lambda f: change(f, signals=[]), "is damaged"),
        (lambda f: change(f, normal=[]), "is damaged"),
        (lambda f: change(f, network={"encoder": ["tanh"] * 9, "decoder": ["linear"]}), "is damaged"),
        (break_tensor, "is not the one its manifest describes"),
        (lambda f: (f / "model.safetensors").write_bytes(b""), "is not the one its manifest describes"),
    ],
)
def test_says_in_a_sentence_what_is_wrong(folder, damage, text):
    damage(folder)
    with pytest.raises(CheckpointError) as caught:
        BodySchema.load(folder)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(folder.name) in str(caught.value)


def test_the_service_side_never_loads_torch():
    modules = "schema, adapt, control, losses, dataset, estimate, anomaly, checkpoint, signals, masks, scaler, descent"
    code = f"import sys; from gemuco import {modules}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
