import numpy as np
import pytest
from muscle_arm import MuscleArm

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.errors import SchemaError, UnknownSignal, WrongSize

FL = frozenset({"muscle_tension", "muscle_length"})
WORN = MuscleArm(softness=1.4, offset=(0.012, -0.004, -0.01, 0.006, 0.008))


def joint_error(schema, arm):
    """Mean distance [rad] of postures estimated from tension and length."""
    values = arm.sample(400, 31)
    found = schema.infer(schema.normalise(values), FL)[:, schema.out_layout.slice("joint_position")]
    theta = found * schema.scaler.std[:2] + schema.scaler.mean[:2]
    return np.linalg.norm(theta - values["joint_position"], axis=1).mean()


def live(updater, arm, count, seed=0):
    values = arm.sample(count, seed)
    for index in range(count):
        updater.add({name: array[index] for name, array in values.items()})
        result = updater.step()
    return result


@pytest.mark.parametrize("config", [UpdateConfig(), UpdateConfig(optimiser="sgd", rate=0.02)])
@pytest.mark.slow
def test_learns_a_body_that_changed(schema, config):
    updater = Updater(schema, config)
    before = joint_error(schema, WORN)
    live(updater, WORN, 600)
    after = joint_error(updater.schema, WORN)
    assert before > 0.15  # rad
    assert after < 0.5 * before


@pytest.mark.slow
def test_errors_are_those_of_the_body_of_today(schema):
    updater = Updater(schema)
    live(updater, WORN, 400)
    claimed = updater.schema.errors["mask", FL][updater.schema.out_layout.slice("joint_position")]
    assert np.linalg.norm(claimed) == pytest.approx(joint_error(updater.schema, WORN), rel=0.6)


def test_what_was_handed_out_never_changes(schema):
    updater = Updater(schema, UpdateConfig(minimum=10))
    before = schema.weights.encoder[0].matrix.copy()
    live(updater, WORN, 30)
    handed = updater.schema
    copy = handed.weights.encoder[0].matrix.copy()
    live(updater, WORN, 5, seed=1)
    np.testing.assert_array_equal(schema.weights.encoder[0].matrix, before)
    np.testing.assert_array_equal(handed.weights.encoder[0].matrix, copy)


def test_waits_for_enough_and_drops_the_oldest(schema):
    updater = Updater(schema, UpdateConfig(window=20, minimum=10, batch=5, steps=1, replay=5))
    result = live(updater, WORN, 9)
    assert np.isnan(result.loss)
    assert updater.schema.weights is schema.weights
    result = live(updater, WORN, 21, seed=1)
    assert (result.window, result.dropped) == (20, 10)
    assert np.isfinite(result.loss)


def test_rolls_back(schema):
    updater = Updater(schema, UpdateConfig(minimum=10))
    live(updater, WORN, 30)
    assert updater.schema is not schema
    assert updater.rollback() is schema
    assert updater.schema is schema


@pytest.mark.slow
def test_replay_remembers_the_old_body(schema, arm):
    forgetful, mindful = Updater(schema, UpdateConfig(replay=0)), Updater(schema, UpdateConfig(replay=1000))
    live(forgetful, WORN, 300)
    live(mindful, WORN, 300)
    assert joint_error(mindful.schema, arm) < joint_error(forgetful.schema, arm)


def test_learns_from_what_there_is(schema):
    updater = Updater(schema, UpdateConfig(minimum=10))
    values = {name: array[0] for name, array in WORN.sample(1, 3).items()}
    without_tension = {name: value for name, value in values.items() if name != "muscle_tension"}
    assert not updater.add(without_tension)
    values["muscle_length"] = np.full(5, np.nan)
    assert updater.add(values)
    for seed in range(20):
        sample = {name: array[0] for name, array in WORN.sample(1, seed).items()}
        sample["joint_position"][0] = np.nan
        updater.add(sample)
    assert np.isfinite(updater.step().loss)
    assert all(np.isfinite(array).all() for array in updater.schema.weights.arrays())


def test_says_what_is_wrong(schema):
    with pytest.raises(SchemaError, match="Known: adam, sgd"):
        UpdateConfig(optimiser="newton")
    with pytest.raises(UnknownSignal):
        Updater(schema).add({"wire": np.zeros(5)})
    with pytest.raises(WrongSize):
        Updater(schema).add({"muscle_length": np.zeros(4)})


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"window": 0}, "window is 0; it must be at least 1"),
        ({"batch": 2.5}, "batch is 2.5; it must be a whole number"),
        ({"steps": -1}, "steps is -1"),
        ({"rate": float("nan")}, "rate is nan"),
        ({"held_out": -1}, "held_out is -1"),
        ({"held_out": 1}, "holds every sample out"),
    ],
)
def test_a_wrong_setting_is_a_sentence(wrong, text):
    with pytest.raises(SchemaError) as caught:
        UpdateConfig(**wrong)
    assert text in str(caught.value)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_step_out_of_the_numbers_is_not_taken(schema):
    updater = Updater(schema, UpdateConfig(minimum=10, optimiser="sgd", rate=1e30))
    result = live(updater, WORN, 12)
    assert result.loss == np.inf
    assert all(np.isfinite(array).all() for array in updater.schema.weights.arrays())
    assert np.isfinite(joint_error(updater.schema, WORN))


@pytest.mark.long
def test_rare_samples_are_gone_through_more_often(schema):
    rare = Updater(schema, UpdateConfig(rate=1e-3))
    once = Updater(schema, UpdateConfig(rate=1e-3, repeats=1))
    live(rare, WORN, 60)
    live(once, WORN, 60)
    assert joint_error(schema, WORN) > 0.2  # rad
    assert joint_error(rare.schema, WORN) < 0.17  # rad
    assert joint_error(rare.schema, WORN) < 0.9 * joint_error(once.schema, WORN)


def test_steps_are_owed_and_paid_later(schema):
    updater = Updater(schema, UpdateConfig(minimum=5, steps=2))
    values = WORN.sample(6, 4)
    rows = [{name: array[index] for name, array in values.items()} for index in range(6)]
    for row in rows[:4]:
        updater.add(row)
    assert updater.owed == 0
    updater.add(rows[4])
    assert updater.owed == 2 * 30
    assert updater.step(most=25).steps == 25
    assert updater.owed == 35
    assert updater.step().steps == 35
    assert updater.step().steps == 0
    settled = updater.schema
    for _ in range(20):
        updater.add(rows[4])
        assert updater.step().steps == 0
    assert updater.schema.weights is settled.weights, "a robot at rest does not pull W"


def test_the_errors_of_a_short_change_are_seen_soon(schema):
    """Without a gradient step W is that of the training, and its error on the worn arm is known after 30 samples."""
    updater = Updater(schema, UpdateConfig(steps=0))
    live(updater, WORN, 30)
    claimed = updater.schema.errors["mask", FL][updater.schema.out_layout.slice("joint_position")]
    assert np.linalg.norm(claimed) == pytest.approx(joint_error(schema, WORN), rel=0.35)
    grown = {key: error for key, error in updater.schema.errors.items() if key[0] == "latent"}
    assert grown
    for key, error in grown.items():
        assert error.mean() > schema.errors[key].mean()
