"""A model whose numbers cannot be those of any training is refused, also if both of its hashes are right."""

import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from muscle_arm import LAYOUT
from safetensors.numpy import load as tensors_of
from safetensors.numpy import save as bytes_of

from gemuco.anomaly.healthy import learn_normal
from gemuco.anomaly.score import score
from gemuco.checkpoint import MANIFEST, load, save, signed
from gemuco.errors import CheckpointError


@pytest.fixture(scope="session")
def watched(schema, arm):
    """The arm's model with every part that a detector may have."""
    return schema.with_normal(learn_normal(schema, LAYOUT.join(arm.sample(400, 21))))


@pytest.fixture(scope="session")
def saved(watched, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound") / "model"
    save(watched, folder)
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "model")


def forge(folder, change, facts=lambda normal: None):
    """Change arrays and facts of the detector, and make all hashes right."""
    head = json.loads((folder / MANIFEST).read_text())
    path = folder / head["tensors"]["file"]
    arrays = {name: array.copy() for name, array in tensors_of(path.read_bytes()).items()}
    change(arrays)
    facts(head["normal"])
    data = bytes_of(arrays)
    path.write_bytes(data)
    head["tensors"]["sha256"] = hashlib.sha256(data).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(signed(head)))


def times(name, factor, where=...):
    def change(arrays):
        arrays[name][where] = arrays[name][where] * factor

    return change


def put(name, value, where=...):
    def change(arrays):
        arrays[name][where] = value

    return change


def untouched(_):
    """Change no array."""


def fact(name, value):
    return lambda normal: normal.__setitem__(name, value)


def scale(place, value):
    return lambda normal: normal["scale"].__setitem__(place, value)


def coupled(arrays):
    """Make two errors more alike than one is to itself."""
    matrix = arrays["normal.covariance"]
    matrix[[0, 1], [1, 0]] = 2.0 * matrix[:2, :2].max()


def clipped(arrays):
    arrays["normal.watch.high"] = arrays["normal.watch.low"]


FORGED = {
    "threshold NaN": (untouched, fact("threshold", float("nan"))),
    "threshold infinite": (untouched, fact("threshold", float("inf"))),
    "threshold huge": (untouched, fact("threshold", 1e308)),
    "threshold negative": (untouched, fact("threshold", -1.0)),
    "threshold text": (untouched, fact("threshold", "high")),
    "threshold missing": (untouched, fact("threshold", None)),
    "threshold doubled": (untouched, lambda normal: normal.update(threshold=2.0 * normal["threshold"])),
    "threshold of no limit": (put("normal.windows.limits", 1e300), untouched),
    "scale std zero": (untouched, scale(1, 0.0)),
    "scale std huge": (untouched, scale(1, 1e300)),
    "scale mean NaN": (untouched, scale(0, float("nan"))),
    "false alarms always": (untouched, fact("false_alarm", 1.0)),
    "bound of rates": (untouched, fact("bound", -1.0)),
    "samples NaN": (untouched, fact("samples", float("nan"))),
    "covariance negative": (times("normal.covariance", -1.0), untouched),
    "covariance huge": (times("normal.covariance", 1e12), untouched),
    "covariance tiny": (times("normal.covariance", 1e-12), untouched),
    "one variance negative": (times("normal.covariance", -1.0, (0, 0)), untouched),
    "one variance huge": (times("normal.covariance", 1e12, (2, 2)), untouched),
    "not symmetric": (put("normal.covariance", 1e-3, (0, 1)), untouched),
    "not definite": (coupled, untouched),
    "no mean": (put("normal.mean", np.nan), untouched),
    "mean infinite": (put("normal.mean", np.inf, 0), untouched),
    "windows without limit": (put("normal.windows.limits", 1e9, -1), untouched),
    "windows NaN": (put("normal.windows.limits", np.nan, -1), untouched),
    "windows of no std": (put("normal.windows.stds", 0.0), untouched),
    "windows that vary much": (put("normal.windows.variance", 1e30), untouched),
    "windows of size 0": (put("normal.windows.sizes", 0), untouched),
    "shift without limit": (put("normal.windows.shift", 1e30), untouched),
    "scatter without limit": (put("normal.windows.scatter", 1e30, -1), untouched),
    "negative scatter": (put("normal.windows.scatter", -1.0, -1), untouched),
    "watch clips all": (clipped, untouched),
    "watch reads beyond": (put("normal.watch.inputs", 10_000, 0), untouched),
    "watch penalised": (put("normal.watch.penalties", 1e30), untouched),
    "moments negative": (times("normal.watch.moments", -1.0), untouched),
}  # fmt: skip


@pytest.mark.parametrize("case", FORGED.values(), ids=list(FORGED))
def test_a_blinded_detector_is_refused(case, folder):
    change, facts = case
    forge(folder, change, facts)
    with pytest.raises(CheckpointError) as caught:
        load(folder)
    prediction = str(caught.value)
    assert "is damaged" in prediction and "KeyError" not in prediction and "\n" not in prediction


@pytest.mark.parametrize(
    "change",
    [
        put("scaler.std", 1e-300),
        put("scaler.std", 1e-300, 0),
        put("scaler.std", 1e300),
        times("scaler.std", 100.0),
        times("scaler.std", -1.0),
        put("scaler.low", 1e9),
        put("scaler.high", 1e300),
        put("errors.0", -1.0),
        put("errors.0", -1.0, 0),
    ],
)
def test_an_impossible_scale_is_refused(change, folder):
    forge(folder, change)
    with pytest.raises(CheckpointError, match="is damaged"):
        load(folder)


def test_the_untouched_model_is_sound(folder, watched, arm):
    forge(folder, untouched)
    values = {name: array[0] for name, array in arm.sample(1, 3).items()}
    assert score(load(folder), values).score == score(watched, values).score


def test_an_unsound_model_is_not_saved_over_a_sound_one(folder, watched):
    bad = watched.with_normal(replace(watched.normal, covariance=-watched.normal.covariance))
    before = (folder / MANIFEST).read_bytes()
    with pytest.raises(CheckpointError, match=r"not saved in .*, because it is not sound: the covariance"):
        save(bad, folder)
    assert (folder / MANIFEST).read_bytes() == before
