"""From a model of the designer's body to one of the real body, on few samples."""

from dataclasses import replace

import numpy as np
import pytest
from muscle_arm import LAYOUT, MuscleArm

from gemuco.dataset import Dataset, Episode
from gemuco.errors import DatasetError, NotEnoughData
from gemuco.learning.train import TrainConfig, fit
from gemuco.learning.tune import fine_tune
from gemuco.signals import Layout

FL = frozenset({"muscle_tension", "muscle_length"})
MASKS = [{"joint_position", "muscle_tension"}, FL]
CONFIG = TrainConfig(hidden=(40, 20), latent=7, epochs=60, batch=50, rate=1e-2, bias_size=2, patience=99)
GENTLE = replace(CONFIG, rate=2e-3, epochs=30)
BODIES = {"light": MuscleArm(softness=1.0), "heavy": MuscleArm(softness=2.0)}
REAL = MuscleArm(softness=2.5, offset=(0.004, -0.003, 0.002, 0.0, -0.004))


def recorded(bodies, size, seed):
    parts = [Episode(name, body.sample(size, seed + i)) for i in range(5) for name, body in bodies.items()]
    return Dataset(LAYOUT, tuple(parts))


@pytest.fixture(scope="module")
def simulated():
    return fit(recorded(BODIES, 200, 0), CONFIG, MASKS)[0]


@pytest.fixture(scope="module")
def tuned(simulated):
    return fine_tune(simulated, recorded({"heavy": REAL}, 24, 100), GENTLE)


def joint_error(schema, body):
    """Root mean square error of the joint angles told from tensions and lengths [rad]."""
    values = body.sample(400, 999)
    x = schema.normalise(values)
    miss = (schema.infer(x, FL) - x)[:, :2] * schema.scaler.std[:2]
    return float(np.sqrt(np.mean(miss**2)))


@pytest.mark.long
def test_few_samples_are_enough(simulated, tuned):
    schema, history = tuned
    before = joint_error(simulated.under("heavy"), REAL)
    after = joint_error(schema.under("heavy"), REAL)
    alone = fit(recorded({"heavy": REAL}, 24, 100), CONFIG, MASKS)[0]
    assert after < 0.8 * before
    assert after < joint_error(alone, REAL)
    assert after < 0.15  # [rad]
    assert history.held_out[history.best_epoch] < history.held_out[0]


@pytest.mark.long
def test_what_was_known_is_kept(simulated, tuned):
    schema = tuned[0]
    np.testing.assert_array_equal(schema.biases["light"], simulated.biases["light"])
    assert not np.array_equal(schema.biases["heavy"], simulated.biases["heavy"])
    np.testing.assert_array_equal(schema.bias, schema.biases["heavy"])
    kept = joint_error(schema.under("light"), BODIES["light"])
    forgetful = fine_tune(simulated, recorded({"heavy": REAL}, 24, 100), replace(GENTLE, replay=0.0))[0]
    assert kept < joint_error(forgetful.under("light"), BODIES["light"])
    before = joint_error(simulated.under("light"), BODIES["light"])
    assert kept < 3.0 * before  # 1.5 to 2.5 over six seeds
    even = fine_tune(simulated, recorded({"heavy": REAL}, 24, 100), replace(GENTLE, replay=1.0))[0]
    assert joint_error(even.under("light"), BODIES["light"]) < 2.0 * before  # 1.3 to 1.9
    assert schema.scaler is simulated.scaler


@pytest.mark.long
def test_anchors_are_of_the_body_as_it_is(simulated, tuned):
    schema = tuned[0]
    names = list(schema.biases)
    assert names == ["light", "heavy"]
    heavy = schema.anchor_conditions == 1
    assert 0 < heavy.sum() <= 120  # the new samples alone
    assert (~heavy).sum() == (simulated.anchor_conditions == 0).sum()


def test_a_new_condition_gets_its_own_p(simulated):
    schema = fine_tune(simulated, recorded({"worn": REAL}, 24, 100), replace(GENTLE, epochs=5))[0]
    assert list(schema.biases) == ["light", "heavy", "worn"]
    for name in BODIES:
        np.testing.assert_array_equal(schema.biases[name], simulated.biases[name])
    assert set(schema.anchor_conditions) == {0, 1, 2}
    assert joint_error(schema.under("worn"), REAL) < joint_error(simulated, REAL)


def test_without_parametric_bias(simulated):
    plain = fit(recorded({"light": BODIES["light"]}, 100, 0), replace(CONFIG, bias_size=0, epochs=20), MASKS)[0]
    schema, _ = fine_tune(plain, recorded({"light": REAL}, 24, 100), replace(GENTLE, bias_size=0))
    assert joint_error(schema, REAL) < joint_error(plain, REAL)
    assert len(schema.biases) == 0


def test_says_what_is_wrong(simulated):
    with pytest.raises(DatasetError, match="Signal 'muscle_tension' is not in the data"):
        layout = Layout((LAYOUT.signal("joint_position"),))
        fine_tune(simulated, Dataset(layout, (Episode("a", {"joint_position": np.zeros((20, 2))}),)), GENTLE)
    values = REAL.sample(40, 0)
    values["muscle_tension"][:, 2] = np.nan
    with pytest.raises(NotEnoughData, match="No sample has all signals of any mask"):
        fine_tune(simulated, Dataset(LAYOUT, (Episode("heavy", values),)), GENTLE)


def slow(body, count, seed):
    """Samples of a motion whose neighbours resemble each other over a dozen samples."""
    values = body.sample(count // 12 + 3, seed)
    at = np.arange(count) / 12
    low, share = at.astype(int), (at % 1.0)[:, None]
    mixed = {name: (1.0 - share) * rows[low] + share * rows[low + 1] for name, rows in values.items()}
    return mixed | {"muscle_length": body.length(mixed["joint_position"], mixed["muscle_tension"])}


@pytest.mark.slow
@pytest.mark.parametrize("motion", [MuscleArm.sample, slow])
def test_two_standard_deviations_cover_fresh_samples_after_100_rows(simulated, motion):
    shares = []
    for seed in range(5):
        schema, _ = fine_tune(simulated, Dataset(LAYOUT, (Episode("heavy", motion(REAL, 100, 40 + seed)),)), GENTLE)
        x = schema.normalise(REAL.sample(400, 999))
        miss = np.abs(schema.infer(x, FL) - x)[:, :2] * schema.scaler.std[:2]  # [rad]
        shares.append(np.mean(miss <= 2.0 * schema.errors["mask", FL][:2]))
    assert 0.9 <= np.mean(shares) <= 0.98


def test_rows_of_a_condition_that_cannot_be_divided_are_measured_once(simulated):
    data = recorded({"heavy": REAL}, 24, 100)
    alone = Dataset(LAYOUT, (*data.episodes, Episode("worn", REAL.sample(3, 1))))
    schema, _ = fine_tune(simulated, alone, replace(GENTLE, epochs=3))
    assert set(schema.biases) == {"light", "heavy", "worn"}
    assert np.isfinite(schema.errors["mask", FL]).all()
