"""What data may be like: with gaps, wild values, dead channels, rare motions, a single condition."""

from dataclasses import replace

import numpy as np
import pytest
from muscle_arm import LAYOUT

from gemuco.dataset import Dataset, Episode
from gemuco.errors import NotEnoughData, SchemaError
from gemuco.learning import outliers
from gemuco.learning.material import Material
from gemuco.learning.task import Task
from gemuco.learning.train import TrainConfig, fit
from gemuco.scaler import Scaler

MASKS = [{"joint_position", "muscle_tension"}, {"muscle_tension", "muscle_length"}]
SMALL = TrainConfig(hidden=(40, 20), latent=7, epochs=40, batch=50, rate=1e-2, patience=99)


def episodes(arm, count=8, size=150, change=None):
    parts = []
    for seed in range(count):
        values = arm.sample(size, seed)
        if change is not None:
            change(values, np.random.default_rng(seed))
        parts.append(Episode("new", values))
    return Dataset(LAYOUT, tuple(parts))


def joint_error(schema, arm):
    """Root mean square error of the joint angles told from tensions and lengths [rad]."""
    values = arm.sample(500, 77)
    x = schema.normalise({name: values[name] for name in ("muscle_tension", "muscle_length")})
    prediction = schema.scaler.restore(np.pad(schema.infer(x, frozenset(MASKS[1])), ((0, 0), (0, 0))))
    return float(np.sqrt(np.mean((prediction[:, :2] - values["joint_position"]) ** 2)))


def wild(values, random):
    for name, array in values.items():
        hit = random.random(array.shape) < 0.01
        array[hit] += 10.0 * array.std() * random.choice([-1.0, 1.0], hit.sum())
        values[name] = array


@pytest.mark.long
def test_outliers_cost_little_and_are_counted(arm):
    clean = joint_error(fit(episodes(arm), SMALL, MASKS)[0], arm)
    dirty = episodes(arm, change=wild)
    schema, history = fit(dirty, SMALL, MASKS)
    naive, unaware = fit(dirty, replace(SMALL, outliers=float("inf")), MASKS)
    assert joint_error(schema, arm) < 1.3 * clean + 0.01  # [rad]
    assert joint_error(naive, arm) > 2.0 * joint_error(schema, arm)
    train = dirty.split(SMALL.held_out, SMALL.seed)[0]
    affected = 0.01 * len(train) * LAYOUT.size
    assert 0.7 * affected < history.rejected < 1.5 * affected
    assert unaware.rejected == 0
    promised = schema.errors["mask", frozenset(MASKS[1])][:2]
    assert np.all(promised < 0.2)  # [rad]: the promise is not about the wild values


@pytest.mark.long
def test_clean_data_are_not_rejected(arm):
    _, history = fit(episodes(arm), SMALL, MASKS)
    assert (history.rejected, history.skipped, history.dead, history.notes) == (0, 0, (), ())


def test_rare_postures_are_not_outliers(arm):
    def rarely_far(values, random):
        far = random.random(len(values["joint_position"])) < 0.02
        values["joint_position"][far] = random.uniform([1.5, 2.2], [1.8, 2.5], (far.sum(), 2))
        values["muscle_length"][:] = arm.length(values["joint_position"], values["muscle_tension"])

    data = episodes(arm, change=rarely_far)
    rare = (data.rows()[:, 0] > 1.4).sum()
    schema, history = fit(data, SMALL, MASKS)
    assert rare > 15
    assert history.rejected < 0.1 * rare
    x = schema.normalise({name: data.layout.split(data.rows())[name] for name in LAYOUT.names})
    far = data.rows()[:, 0] > 1.4
    miss = schema.infer(x[far], frozenset(MASKS[1]))[:, :2] - x[far][:, :2]
    assert np.sqrt(np.mean(miss**2)) < 0.6  # of standard deviations; they are 3.5 away from the mean


def test_one_wild_value_does_not_set_the_scale(arm):
    rows = LAYOUT.join(arm.sample(500, 0))
    clean = Scaler.fit(LAYOUT, rows)
    rows[3, 4] = 1e9
    rows[5, 0] = -np.inf
    dirty = Scaler.fit(LAYOUT, rows)
    np.testing.assert_allclose(dirty.std, clean.std, rtol=0.02)
    np.testing.assert_allclose(dirty.high, clean.high, rtol=0.05)


def test_a_switch_that_is_rarely_on_keeps_its_scale(arm):
    rows = LAYOUT.join(arm.sample(500, 0))
    rows[:, 0] = 0.0
    rows[::100, 0] = 1.0
    scaler = Scaler.fit(LAYOUT, rows)
    assert scaler.high[0] == 1.0
    assert 0 not in scaler.dead


def stuck(values, random):
    values["muscle_tension"][:, 3] = 12.5
    values["muscle_length"][:, 1] = np.nan


def test_dead_channels_are_named_and_do_no_harm(arm):
    schema, history = fit(episodes(arm, change=stuck), SMALL, MASKS)
    assert history.dead == ("muscle_tension.extensor", "muscle_length.back")
    assert history.skipped == 0
    values = {name: array[0] for name, array in arm.sample(1, 5).items()}
    stuck({name: array[None] for name, array in values.items()}, None)
    values["muscle_length"][1] = 0.3
    quiet = schema.infer(schema.normalise(values), schema.masks[0])
    values["muscle_tension"][3] += 5.0  # the stuck sensor comes alive
    values["muscle_length"][1] += 0.1
    for mask in schema.masks:
        prediction = schema.infer(schema.normalise(values), mask)
        if mask == schema.masks[0]:
            np.testing.assert_array_equal(prediction, quiet)
        assert schema.scaler.restore(prediction)[5] == pytest.approx(12.5)
    assert joint_error(schema, arm) < 0.25


def test_a_signal_that_was_never_measured_is_left_out(arm):
    def silent(values, _random):
        values["joint_position"][:] = np.nan

    masks = [*MASKS, {"muscle_length"}]
    schema, history = fit(episodes(arm, change=silent), replace(SMALL, epochs=3), masks)
    assert schema.x_out == ("muscle_tension", "muscle_length")
    assert frozenset(MASKS[0]) not in schema.masks
    assert "Signal 'joint_position' was never measured" in history.notes[0]
    assert history.dead == ("joint_position.shoulder", "joint_position.elbow")
    with pytest.raises(NotEnoughData, match="joint_position was never measured"):
        fit(episodes(arm, change=silent), SMALL, [{"joint_position"}])


@pytest.mark.parametrize(("epochs", "searches"), [(12, 4), pytest.param(96, 16, marks=pytest.mark.long)])
def test_outliers_are_searched_for_as_often_as_the_training_can_afford(arm, monkeypatch, epochs, searches):
    count, find = [0], outliers.find

    def counted(*given):
        count[0] += 1
        return find(*given)

    monkeypatch.setattr(outliers, "find", counted)
    fit(episodes(arm), replace(SMALL, epochs=epochs, patience=1000), [{name} for name in LAYOUT.names])
    judged = count[0] // 2 - 1  # training and held-out samples; once more at the end
    assert 0.7 * searches <= judged <= searches  # after a quarter of the epochs


def test_rows_that_hold_one_signal_each_are_trained_without_what_is_normal(arm):
    def one_each(values, _random):
        for index, name in enumerate(LAYOUT.names):
            values[name][np.arange(len(values[name])) % 3 != index] = np.nan

    schema, _ = fit(episodes(arm, change=one_each), replace(SMALL, epochs=3), [{name} for name in LAYOUT.names])
    assert schema.normal is None


def test_a_signal_that_never_varies_is_named(arm):
    def still(values, _random):
        values["joint_position"][:] = [0.4, 1.1]

    schema, history = fit(episodes(arm, change=still), replace(SMALL, epochs=3), MASKS)
    assert history.dead == ("joint_position.shoulder", "joint_position.elbow")
    prediction = schema.scaler.restore(schema.infer(np.zeros(LAYOUT.size), schema.masks[1]))
    np.testing.assert_allclose(prediction[:2], [0.4, 1.1])
    noisy = schema.normalise({"joint_position": np.array([0.41, 1.1])})
    assert abs(noisy[0]) < 0.1  # a little noise stays little


def test_gaps_are_counted_and_masks_that_hide_them_are_used(arm):
    def gaps(values, random):
        values["joint_position"][random.random(len(values["joint_position"])) < 0.5] = np.nan
        values["muscle_tension"][:10] = np.nan

    data = episodes(arm, change=gaps)
    schema, history = fit(data, SMALL, MASKS)
    train = data.split(SMALL.held_out, SMALL.seed)[0]
    assert history.skipped == 10 * len(train.episodes)
    assert joint_error(schema, arm) < 0.25


def test_one_condition_leaves_p_without_effect(arm):
    schema, history = fit(episodes(arm), replace(SMALL, epochs=3, bias_size=2), MASKS)
    assert "All data are of one condition ('new')" in history.notes[0]
    np.testing.assert_array_equal(schema.biases["new"], [0.0, 0.0])
    x = schema.normalise({name: array[0] for name, array in arm.sample(1, 3).items()})
    moved = schema.with_bias(np.array([5.0, -3.0]))
    np.testing.assert_array_equal(moved.infer(x, schema.masks[0]), schema.infer(x, schema.masks[0]))


@pytest.mark.parametrize(
    ("bias_size", "length", "note"),
    [
        (None, 1, "p has length 1, because the data are of 2 conditions (new, worn)."),
        (0, 0, "The 2 conditions of the data (new, worn) are not distinguished, because the length of p was set to 0"),
        (2, 2, None),
    ],
)
def test_p_follows_the_conditions_unless_its_length_is_set(arm, bias_size, length, note):
    parts = [Episode(n, arm.sample(30, s)) for s in range(5) for n in ("new", "worn")]
    schema, history = fit(Dataset(LAYOUT, tuple(parts)), replace(SMALL, epochs=2, bias_size=bias_size), MASKS)
    assert len(schema.bias) == length
    assert set(schema.biases) == ({"new", "worn"} if length else set())
    assert [text[: len(note or "")] for text in history.notes] == ([note] if note else [])


def test_p_that_follows_one_condition_is_of_length_0_and_of_many_of_length_3():
    assert [TrainConfig().bias_for(count) for count in (1, 2, 3, 4, 9)] == [0, 1, 2, 3, 3]


@pytest.mark.slow
def test_errors_are_measured_under_each_p(arm):
    soft = type(arm)(softness=3.0)
    parts = [Episode(n, b.sample(400, s)) for s in range(5) for n, b in (("new", arm), ("worn", soft))]
    schema, _ = fit(Dataset(LAYOUT, tuple(parts)), replace(SMALL, bias_size=1), MASKS)
    values = soft.sample(400, 50)
    x = schema.normalise(values)
    miss = schema.under("worn").infer(x, frozenset(MASKS[0])) - x
    found = np.sqrt(np.mean(miss**2, axis=0)) * schema.scaler.std
    promised = schema.errors["mask", frozenset(MASKS[0])]
    assert np.all(found < 1.6 * promised)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"latent": 0}, "latent is 0; it must be at least 1"),
        ({"epochs": 0}, "epochs is 0"),
        ({"hidden": (20, 0)}, "a hidden layer of 0"),
        ({"rate": float("nan")}, "rate is nan"),
        ({"held_out": 1.0}, "held_out is 1.0"),
        ({"outliers": 0.0}, "use infinity to reject nothing"),
        ({"bias_size": -1}, "bias_size is -1"),
        ({"latent": 2.5}, "latent is 2.5; it must be a whole number"),
        ({"hidden": (1.5,)}, "hidden layer is 1.5; it must be a whole number"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_a_wrong_setting_is_a_sentence(wrong, text):
    with pytest.raises(SchemaError) as caught:
        TrainConfig(**wrong)
    assert text in str(caught.value)


def test_nothing_measured_at_all():
    values = {name: np.full((40, LAYOUT.signal(name).size), np.nan) for name in LAYOUT.names}
    with pytest.raises(NotEnoughData, match="no measured value at all"):
        fit(Dataset(LAYOUT, (Episode("new", values),)), SMALL, MASKS)


def test_a_suspicion_is_cleared_once_the_model_bears_the_sample_out(schema, arm):
    rows = schema.scaler.normalise(LAYOUT.join(arm.sample(100, 8)))
    task = Task(LAYOUT, schema.masks, schema.x_out, schema.linear)
    material = Material(task, rows, np.zeros(100, int), schema.scaler)
    suspected = np.zeros((100, 3), bool)
    suspected[:40, 1] = True  # tension, which is in every mask: only masks with it can judge it
    suspected[40:80, 0] = True
    material.hide(suspected)
    assert outliers.find(material, schema.weights, np.zeros((100, 0)), 6.0).sum() == 0
