"""Adaption to a list of samples."""

import numpy as np
import pytest
from muscle_arm import LAYOUT, MuscleArm

from gemuco.adaption.adapt import LEAST, adapt
from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.gradient import mean_error
from gemuco.dataset import Dataset, Episode
from gemuco.estimation import estimate
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.schema import BodySchema

FL = frozenset({"muscle_tension", "muscle_length"})
WORN = MuscleArm(softness=1.4, offset=(0.012, -0.004, -0.01, 0.006, 0.008))
BODIES = {"light": MuscleArm(), "worn": WORN}


def listed(arm, count, seed=0):
    """Return samples of an arm, one mapping each."""
    values = arm.sample(count, seed)
    return [{name: rows[index] for name, rows in values.items()} for index in range(count)]


def misses(schema, arm):
    """Return the errors of the joint positions inferred from tension and length [rad], shape (400, 2)."""
    x = schema.normalise(arm.sample(400, 999))
    return (schema.infer(x, FL) - x)[:, :2] * schema.scaler.std[:2]


def joint_error(schema, arm):
    """Return the mean error of the posture inferred from tension and length [rad]."""
    return float(np.linalg.norm(misses(schema, arm), axis=1).mean())


@pytest.fixture(scope="module")
def two_bodies() -> BodySchema:
    config = TrainConfig(hidden=(40, 20), latent=7, epochs=60, batch=50, bias_size=2)
    parts = tuple(Episode(name, body.sample(200, i)) for i in range(5) for name, body in BODIES.items())
    return fit(Dataset(LAYOUT, parts), config, [{"joint_position", "muscle_tension"}, FL])[0]


@pytest.mark.long
def test_hundred_samples_are_learned_until_the_error_stops_falling(schema):
    adapted = adapt(schema, listed(WORN, 100))
    facts = adapted.manifest["adaption"]
    assert joint_error(schema, WORN) > 0.15  # [rad]
    assert joint_error(adapted, WORN) < 0.08  # [rad]
    assert (facts["moved"], facts["samples"]) == ("W", 100)
    assert 0 < facts["steps"] <= LEAST
    assert facts["error_after"] < 0.5 * facts["error_before"]


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 6, 9, 20])
def test_few_samples_never_make_it_worse(schema, count):
    before = joint_error(schema, WORN)
    errors = [joint_error(adapt(schema, listed(WORN, count, seed)), WORN) for seed in range(5)]
    assert max(errors) < 1.02 * before
    assert np.mean(errors) < before


@pytest.mark.long
def test_a_body_that_has_not_changed_is_left_alone(schema, arm):
    before = joint_error(schema, arm)
    for seed in range(3):
        adapted = adapt(schema, listed(arm, 8, seed))
        assert joint_error(adapted, arm) < 1.1 * before


@pytest.mark.long
def test_samples_that_teach_nothing_move_nothing(schema):
    """In pure noise no part of the list helps to predict another."""
    random = np.random.default_rng(3)
    rows = schema.scaler.restore(random.standard_normal((40, schema.layout.size)))
    adapted = adapt(schema, [schema.layout.split(row) for row in rows], UpdateConfig(rate=1e-2, replay=0))
    facts = adapted.manifest["adaption"]
    if facts["moved"] == "nothing":
        assert adapted.weights is schema.weights
        assert facts["steps"] == 0
    assert facts["error_after"] <= facts["error_before"]


def test_one_sample_moves_p_and_never_w(two_bodies):
    adapted = adapt(two_bodies.under("light"), listed(WORN, 1))
    assert adapted.weights is two_bodies.weights
    assert adapted.manifest["adaption"]["moved"] == "p"
    fresh = two_bodies.normalise(WORN.sample(400, 999))
    assert mean_error(adapted, fresh) < 0.4 * mean_error(two_bodies.under("light"), fresh)
    same = adapt(two_bodies.under("light"), [])
    assert same.manifest["adaption"] == {
        "moved": "nothing", "samples": 0, "steps": 0, "error_before": None, "error_after": None,
    }  # fmt: skip
    assert same.weights is two_bodies.weights


@pytest.mark.slow
@pytest.mark.parametrize("what", ["bias", "bias_then_weights", "both"])
def test_expected_errors_are_of_the_body_as_it_is(two_bodies, what):
    """The softness of this body is between those of the training and beyond."""
    between = MuscleArm(softness=1.7, offset=WORN.offset)
    adapted = adapt(two_bodies.under("light"), listed(between, 60), UpdateConfig(what=what, rate=1e-3))
    fresh = between.sample(400, 999)
    given = {name: fresh[name] for name in FL}
    found = estimate(adapted, given)["joint_position"]
    inside = np.abs(found.value - fresh["joint_position"]) <= 2.0 * found.std
    assert 0.88 <= inside.mean() <= 0.99
