import numpy as np
import pytest
from muscle_arm import LAYOUT as ARM

from gemuco.adaption.folds import Folds, chosen, correlation_length, series_of
from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.signals import Layout, Signal

LAYOUT = Layout((Signal("a", 2, "m"),))


def dataset(*sizes, condition="new"):
    rows = np.random.default_rng(0).standard_normal((sum(sizes), 2))
    parts = np.split(rows, np.cumsum(sizes)[:-1])
    return Dataset(LAYOUT, tuple(Episode(condition, {"a": part}) for part in parts))


def divided(data):
    return Folds.of(data.rows(), series_of(data))


@pytest.mark.parametrize("length", [1, 10, 40])
def test_the_correlation_length_of_a_held_value_is_its_duration(length):
    rows = np.repeat(np.random.default_rng(1).standard_normal((4000 // length, 3)), length, axis=0)
    rows[::7, 1] = np.nan
    assert correlation_length(rows) == pytest.approx(length, rel=0.15)


def test_a_slow_recording_is_cut_into_long_blocks_and_is_doubted():
    slow = np.sin(np.linspace(0.0, 6.0, 100))[:, None]
    folds = Folds.of(slow, [(0, np.arange(100))])
    assert folds.count == 2
    np.testing.assert_array_equal(folds.part, np.repeat([0, 1], 50))
    assert folds.independent < 6.0
    assert folds.doubt > 0.4
    quick = divided(dataset(100))
    assert (quick.count, quick.independent, quick.doubt) == (5, 100.0, 0.0)
    assert quick.widening == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("rows", "student"), [(2, 4.303), (3, 3.182), (6, 2.447), (10, 2.228), (30, 2.042)])
def test_two_widened_standard_deviations_are_the_quantile_of_student(rows, student):
    assert 1.96 * Folds(np.zeros(rows, int), 1, rows).widening == pytest.approx(student, rel=0.03)


def test_episodes_stay_whole_and_every_row_has_a_part():
    data = dataset(4, 5, 6, 7, 8, 9)
    folds = divided(data)
    assert folds.count == 5
    for _, span in series_of(data):
        assert len(set(folds.part[span])) == 1
    for part in range(folds.count):
        left, taken = chosen(data, folds.part != part), chosen(data, folds.part == part)
        assert len(left) + len(taken) == len(data)
        assert len(taken)


def test_blocks_leave_two_series_that_do_not_touch():
    data = dataset(100)
    left = chosen(data, divided(data).part != 2)
    assert [len(episode.values["a"]) for episode in left.episodes] == [40, 40]
    np.testing.assert_array_equal(left.rows(), np.delete(data.rows(), np.arange(40, 60), axis=0))


def test_few_rows_are_not_divided():
    assert divided(dataset(3)).count == 1
    assert divided(dataset(4)).count == 2


@pytest.mark.long
def test_a_model_of_one_short_motion_claims_little_about_other_motion(arm):
    """100 rows of a motion through five postures: from held-out rows alone two standard deviations cover a fifth."""
    values = arm.sample(5, 0)
    at = np.linspace(0.0, 3.999, 100)
    low, share = at.astype(int), (at % 1.0)[:, None]
    motion = {name: (1.0 - share) * rows[low] + share * rows[low + 1] for name, rows in values.items()}
    motion["muscle_length"] = arm.length(motion["joint_position"], motion["muscle_tension"])
    mask = frozenset({"muscle_tension", "muscle_length"})
    config = TrainConfig(hidden=(40, 20), latent=7, batch=50)
    schema, _ = fit(Dataset(ARM, (Episode("new", motion),)), config, [mask])
    claimed, spread = schema.errors["mask", mask][:2], schema.scaler.std[:2]  # [rad]
    assert np.all(claimed > 0.5 * spread), "what was never seen is not known"
    x = schema.normalise(arm.sample(400, 999))
    miss = np.abs(schema.infer(x, mask) - x)[:, :2] * spread
    assert np.mean(miss <= 2.0 * claimed) > 0.5
