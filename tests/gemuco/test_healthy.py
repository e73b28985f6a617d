import json
from dataclasses import replace

import numpy as np
import pytest
from muscle_arm import LAYOUT, MuscleArm

from gemuco.anomaly.healthy import learn_normal
from gemuco.anomaly.prediction import all_errors, judgements, with_bias
from gemuco.anomaly.verdict import judge, window_score
from gemuco.anomaly.window import scores
from gemuco.checkpoint import MANIFEST, load, save, signed
from gemuco.compiled.score import residuals
from gemuco.errors import NotEnoughData
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.normal.watch import Watch
from gemuco.normal.windows import area, at_most, limit, tolerance


def walk(arm, count, seed, step=0.6):
    """Return samples of a slow motion: neighbours are alike, as on a robot."""
    random = np.random.default_rng(seed)
    smooth = np.cumsum(random.normal(0.0, 1.0, (count, 7)), axis=0) * step
    theta = np.array([0.0, 0.9]) + 0.6 * np.sin(smooth[:, :2])
    tension = 50.0 + 40.0 * np.sin(smooth[:, 2:])
    noise = random.normal(0.0, 1.0, (count, 12)) * np.r_[np.full(2, 0.002), np.full(5, 0.3), np.full(5, 2e-4)]
    return np.concatenate([theta, tension, arm.length(theta, tension)], axis=1) + noise


@pytest.fixture(scope="module")
def poor(data):
    """A model whose only output is the length: tension and position cannot be inferred from its masks."""
    config = TrainConfig(hidden=(60, 20), latent=7, epochs=30, batch=100)
    return fit(data, config, [("joint_position", "muscle_tension")], x_out=("muscle_length",))[0]


@pytest.fixture(scope="module")
def walking(poor, arm):
    return poor.with_normal(learn_normal(poor, walk(arm, 4000, 1)))


def test_a_load_cell_that_is_no_output_is_watched(walking, arm):
    """A tension that reads 10 N too much: area under the ROC curve of single samples, and of the same for a window."""
    healthy, off = walk(arm, 1000, 2), walk(arm, 1000, 2)
    off[:, LAYOUT.slice("muscle_tension")][:, 1] += 10.0  # N
    well, ill = (scores(walking, walking.scaler.normalise(rows)) for rows in (healthy, off))
    assert area(ill, well) > 0.95
    assert walking.x_out == ("muscle_length",)


def test_false_alarms_are_those_promised(walking, arm):
    found = scores(walking, walking.scaler.normalise(walk(arm, 4000, 3)))
    promised = walking.normal.false_alarm
    assert np.mean(found > walking.normal.threshold) <= walking.normal.bound
    assert promised <= walking.normal.bound < 0.1
    assert "0.1% false alarms promised" in walking.normal.trust
    assert "4000 normal samples" in walking.normal.trust


def test_a_small_shift_is_found_in_a_window_that_no_sample_shows(walking, arm):
    rows = walk(arm, 400, 4)
    healthy = walking.scaler.normalise(rows)
    rows[:, 0] += 0.012  # rad
    shifted = walking.scaler.normalise(rows)
    assert np.mean(scores(walking, shifted) > walking.normal.threshold) < 0.2
    windows = [window_score(walking, shifted[i : i + 100]) for i in range(0, 300, 50)]
    assert min(windows) > 1.0
    assert max(window_score(walking, healthy[i : i + 100]) for i in range(0, 300, 50)) < 1.0


def test_a_window_of_normal_samples_is_normal_at_its_rate(walking, arm):
    x = walking.scaler.normalise(walk(arm, 4000, 5))
    for count in (1, 7, 30, 200):
        alarms = [window_score(walking, x[i : i + count]) > 1.0 for i in range(0, 3800, 20)]
        assert np.mean(alarms) < 0.03, count


def test_missing_elements_are_judged_by_normal_samples_that_lack_them(walking, arm):
    rows = walk(arm, 1000, 6)
    rows[:, 3] = np.nan
    off = rows.copy()
    off[:, 9] += 0.01  # m
    well, ill = (scores(walking, walking.scaler.normalise(part)) for part in (rows, off))
    by = walking.derived(judgements)(np.isfinite(rows[0]))
    assert not by.is_complete
    assert np.mean(well > by.threshold) < 0.01
    assert area(ill, well) > 0.95


def rests(arm, count, seed):
    """Return samples of a body that rests for 17 samples in every posture, as between test poses."""
    random = np.random.default_rng(seed)
    theta, tension = random.uniform([-0.6, 0.3], [0.6, 1.5], (count, 2)), random.uniform(10.0, 90.0, (count, 5))
    theta, tension = np.repeat(theta, 17, axis=0), np.repeat(tension, 17, axis=0)
    noise = random.normal(0.0, 1.0, (17 * count, 12)) * np.r_[np.full(2, 0.002), np.full(5, 0.3), np.full(5, 2e-4)]
    return np.concatenate([theta, tension, arm.length(theta, tension)], axis=1) + noise


@pytest.mark.parametrize("postures", [6, 20, 60])
def test_a_new_posture_is_no_anomaly_after_few_postures(poor, arm, postures):
    """The samples before and after one are nearly equal to it, and say nothing of the next posture."""
    normal = learn_normal(poor, rests(arm, postures, 8))
    learned = poor.with_normal(normal)
    other = rests(arm, 60, 9)
    lost = other.copy()
    lost[:, 0] = np.nan
    for rows in (other, lost):
        found = scores(learned, learned.scaler.normalise(rows))
        threshold = judgements(learned)(np.isfinite(rows[0])).threshold
        assert np.mean(found > threshold) <= normal.bound


def test_too_few_samples_are_an_error_and_not_a_guess(poor, arm):
    with pytest.raises(NotEnoughData, match="at least 30 complete samples; there are 20"):
        learn_normal(poor, walk(arm, 20, 7))


def test_another_body_is_learned_anew_with_what_was_known(walking, arm):
    other = MuscleArm(softness=1.6, offset=(0.004, -0.003, 0.002, 0.0, -0.004))
    few = learn_normal(walking, walk(other, 150, 8))
    alone = learn_normal(walking.with_normal(None), walk(other, 150, 8))
    fresh = walking.scaler.normalise(walk(other, 1000, 9))
    assert np.mean(scores(walking, fresh) > walking.normal.threshold) > 0.5
    assert np.mean(scores(walking.with_normal(few), fresh) > few.threshold) < 0.02
    assert few.bound > walking.normal.bound, "less is known from fewer samples"
    assert few.watch.count >= alone.watch.count


def test_a_verdict_of_shifted_samples_blames_the_sensor(walking, arm):
    rows = walk(arm, 60, 10)
    rows[:, 4] += 25.0  # N
    verdict = judge(walking, [LAYOUT.split(row) for row in rows])
    assert verdict.kind == "anomaly"
    assert verdict.blamed.endswith(".flexor")


def test_slopes_of_the_watch_are_those_of_finite_differences(walking, arm):
    reading = walking.normal.watch.reading(None)
    rows, step = with_bias(walking, walking.scaler.normalise(walk(arm, 3, 11))), 1e-5
    for element in (0, 4, 9):
        more = rows.copy()
        more[:, element] += step
        expected = (reading.residuals(more) - reading.residuals(rows)) / step
        np.testing.assert_allclose(reading.slopes(rows, [element])[:, :, 0], expected, rtol=1e-3, atol=1e-4)


def test_one_inverse_gives_the_regression_of_every_target():
    random = np.random.default_rng(0)
    rows = random.normal(size=(3000, 5)) @ random.normal(size=(5, 5)) * 0.5
    watch = Watch.fit(rows, np.array([0, 0, 1, 1, 1]))
    watch = replace(watch, penalties=np.full(len(watch.penalties), 1e3))  # linear
    reading = watch.reading(None)
    ones = np.ones((len(rows), 1))
    for residual, (element, group) in enumerate([(0, [0]), (1, [1]), (2, [2]), (3, [3]), (4, [4]), (0, [0, 1])]):
        x = np.concatenate([ones, np.delete(rows, group, axis=1)], axis=1)
        expected = rows[:, element] - x @ np.linalg.lstsq(x, rows[:, element], rcond=None)[0]
        found = reading.residuals(rows)[:, residual]
        np.testing.assert_allclose(found, expected, atol=0.02 * expected.std() + 1e-3)


def test_compiled_residuals_are_those_of_numpy(walking, arm):
    raw = walk(arm, 5, 12)
    reading, predictor = walking.normal.watch.reading(None), walking.predictor
    expected = all_errors(walking, reading, with_bias(walking, walking.scaler.normalise(raw)), len(walking.normal.mean))
    for row, right in zip(raw, expected, strict=True):
        found = residuals(
            reading.inputs, reading.clips, reading.pairs, reading.maps, predictor.scale, row, np.zeros(0, np.float32)
        )
        np.testing.assert_allclose(found, right[walking.out_layout.size :], rtol=1e-6, atol=1e-9)


def test_it_is_saved_and_an_older_model_loads_without_a_watch(walking, arm, tmp_path):
    x = walking.scaler.normalise(walk(arm, 50, 13))
    save(walking, tmp_path / "new")
    again = load(tmp_path / "new")
    np.testing.assert_allclose(scores(again, x), scores(walking, x), rtol=1e-6)
    assert window_score(again, x) == pytest.approx(window_score(walking, x))
    outputs = walking.out_layout.size
    old = replace(walking.normal, mean=np.zeros(outputs), covariance=np.eye(outputs), watch=None, scale=None)
    save(walking.with_normal(replace(old, windows=None, rows=np.zeros((0, 0)))), tmp_path / "old")
    head = json.loads((tmp_path / "old" / MANIFEST).read_text())
    head["normal"] = {"threshold": 4.0, "false_alarm": 1e-3}  # as version 2 was written before
    (tmp_path / "old" / MANIFEST).write_text(json.dumps(signed(head)))
    plain = load(tmp_path / "old")
    assert plain.normal.watch is None
    assert np.isfinite(scores(plain, x)).all()
    assert np.isfinite(window_score(plain, x))


def test_limits_of_few_samples_are_wider():
    random = np.random.default_rng(0)
    assert tolerance(1e-3, 20) > tolerance(1e-3, 200) > tolerance(1e-3, 1e6) == pytest.approx(3.09, abs=0.01)
    kept = [np.mean(random.normal(size=20000) > limit(random.normal(size=50), 1e-2, 50)) <= 1e-2 for _ in range(200)]
    assert np.mean(kept) > 0.85  # 0.9 is promised
    assert at_most(0.0, 300) == pytest.approx(0.009, abs=0.001)
