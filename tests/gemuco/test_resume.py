"""A training that was killed goes on and ends as if nothing had happened."""

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from muscle_arm import LAYOUT, MuscleArm

from gemuco.dataset import Dataset, Episode
from gemuco.learning.draft import Draft
from gemuco.learning.train import TrainConfig, fit
from gemuco.learning.tune import fine_tune

MASKS = [{"joint_position", "muscle_tension"}, {"muscle_tension", "muscle_length"}]
CONFIG = TrainConfig(hidden=(16,), latent=5, epochs=20, batch=100, bias_size=1, patience=99)


def two_bodies() -> Dataset:
    bodies = {"new": MuscleArm(), "worn": MuscleArm(softness=2.0)}
    parts = [Episode(name, body.sample(80, seed)) for name, body in bodies.items() for seed in range(5)]
    parts[3].values["muscle_tension"][7, 2] = 900.0
    return Dataset(LAYOUT, tuple(parts))


class Stopped(Exception):
    """What stands for Ctrl-C."""


def stop_at(share):
    def tell(done, _text):
        if done >= share:
            raise Stopped

    return tell


def same(one, other):
    assert one[1].train == other[1].train
    assert one[1].held_out == other[1].held_out
    assert one[1].rejected == other[1].rejected
    for a, b in zip(one[0].weights.arrays(), other[0].weights.arrays(), strict=True):
        np.testing.assert_array_equal(a, b)
    for name, p in one[0].biases.items():
        np.testing.assert_array_equal(other[0].biases[name], p)


@pytest.fixture(scope="module")
def whole():
    return fit(two_bodies(), CONFIG, MASKS)


KILLED = """
import os, signal, sys
sys.path.insert(0, sys.argv[1])
from test_resume import CONFIG, MASKS, two_bodies
from gemuco.learning.train import fit
def tell(done, text):
    if done >= 0.6:
        os.kill(os.getpid(), signal.SIGKILL)
fit(two_bodies(), CONFIG, MASKS, tell, resume=sys.argv[2])
"""


@pytest.mark.long
def test_goes_on_after_a_kill(whole, tmp_path):
    path = tmp_path / "deep" / "training.draft"
    here = str(Path(__file__).parent)
    killed = subprocess.run([sys.executable, "-c", KILLED, here, str(path)], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert path.exists()
    again = fit(two_bodies(), CONFIG, MASKS, resume=path)
    same(again, whole)
    assert (again[1].resumed, whole[1].resumed) == (11, 0)


@pytest.mark.long
def test_a_finished_training_is_not_done_again(whole, tmp_path):
    path = tmp_path / "draft"
    same(fit(two_bodies(), CONFIG, MASKS, resume=path), whole)
    prediction = []
    again = fit(two_bodies(), CONFIG, MASKS, lambda *step: prediction.append(step), resume=path)
    same(again, whole)
    assert (again[1].resumed, prediction) == (CONFIG.epochs, [])


def test_goes_on_after_many_interruptions(whole, tmp_path):
    path = tmp_path / "draft"
    for share in (0.2, 0.35, 0.8):
        with pytest.raises(Stopped):
            fit(two_bodies(), CONFIG, MASKS, stop_at(share), resume=path)
    same(fit(two_bodies(), CONFIG, MASKS, resume=path), whole)


@pytest.mark.long
def test_a_draft_of_another_training_is_left_alone(whole, tmp_path):
    path = tmp_path / "draft"
    with pytest.raises(Stopped):
        fit(two_bodies(), replace(CONFIG, rate=5e-3), MASKS, stop_at(0.5), resume=path)
    found = fit(two_bodies(), CONFIG, MASKS, resume=path)
    same(found, whole)
    assert found[1].resumed == 0


def test_a_damaged_draft_is_begun_anew(whole, tmp_path):
    path = tmp_path / "draft"
    with pytest.raises(Stopped):
        fit(two_bodies(), CONFIG, MASKS, stop_at(0.5), resume=path)
    sound = path.read_bytes()
    random = np.random.default_rng(0)
    for _ in range(30):
        data = bytearray(sound)
        data[random.integers(len(data))] ^= 1 << int(random.integers(8))
        path.write_bytes(data)
        assert Draft(path, "").load() is None
    path.write_bytes(sound[:500])
    same(fit(two_bodies(), CONFIG, MASKS, resume=path), whole)


@pytest.mark.long
def test_fine_tuning_goes_on_too(whole, tmp_path):
    real = Dataset(LAYOUT, (Episode("real", MuscleArm(softness=3.0).sample(60, 9)),))
    config = replace(CONFIG, rate=1e-3)
    straight = fine_tune(whole[0], real, config)
    path = tmp_path / "draft"
    with pytest.raises(Stopped):
        fine_tune(whole[0], real, config, stop_at(0.5 / 6), resume=path)  # five more trainings measure its errors
    again = fine_tune(whole[0], real, config, resume=path)
    same(again, straight)
    assert again[1].resumed == 9
