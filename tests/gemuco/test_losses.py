from dataclasses import replace

import numpy as np
import pytest
from muscle_arm import gravity

from gemuco.errors import NotFinite, NotObservable, UnknownSignal, WrongSize
from gemuco.search.losses import Match, StayNear, StaySmall
from gemuco.search.torque import MuscleModel, TorqueBalance

TARGET = {"joint_position": np.array([0.3, 0.9])}
NOW = {"muscle_length": np.full(5, 0.3), "muscle_tension": np.array([10.0, np.nan, 30.0, 40.0, 50.0])}


@pytest.fixture(scope="module")
def precise(schema):
    """The same body in float64, for finite differences."""
    return replace(schema, weights=schema.weights.astype(np.float64))


@pytest.mark.parametrize(
    "term",
    [
        Match("joint_position", 2.0),
        StayNear("muscle_length", 0.5),
        StayNear("muscle_tension", 0.5),
        StayNear("muscle_tension", value=(20.0, 20.0, 20.0, 20.0, 20.0)),
        StaySmall("muscle_tension", 0.1),
        TorqueBalance(gravity, weight=0.7),
        TorqueBalance(gravity, weight=0.7, at="predicted"),
        Match("joint_position", 2.0, matrix=((1.0, 1.0), (0.0, -0.5), (2.0, 0.3)), value=(0.4, 0.1, 0.0)),
        Match("joint_position", 2.0, matrix=((1.0, 1.0),), value=(0.4,), unit="si"),
        Match("muscle_length", value=(0.3, 0.31, 0.32, 0.33, 0.34), unit="si"),
        StayNear("joint_position", 0.3),
        StaySmall("muscle_tension", 0.1, unit="si"),
    ],
)
def test_gradient_agrees_with_finite_differences(precise, term):
    bound = term.bind(precise, TARGET, NOW)
    x = np.random.default_rng(0).uniform(-1, 1, (3, precise.layout.size))
    _, gradient = bound(x)
    step = 1e-6
    for column in range(x.shape[1]):
        moved = np.zeros_like(x)
        moved[:, column] = step
        slope = (bound(x + moved)[0] - bound(x - moved)[0]) / (2 * step)
        np.testing.assert_allclose(gradient[:, column], slope, rtol=1e-4, atol=1e-6)


def test_units(schema):
    x = np.zeros((1, schema.layout.size))
    std, mean = schema.scaler.std[:2], schema.scaler.mean[:2]
    loss, _ = Match("joint_position").bind(schema, TARGET, {})(x)
    assert loss[0] == pytest.approx(np.linalg.norm((TARGET["joint_position"] - mean) / std))
    tension = schema.layout.slice("muscle_tension")
    loss, _ = StaySmall("muscle_tension").bind(schema, TARGET, {})(x)
    assert loss[0] == pytest.approx(np.linalg.norm(schema.scaler.mean[tension] / schema.scaler.std[tension]))


def test_network_knows_the_moment_arms(schema, arm):
    theta = np.array([0.2, 0.8])
    span = schema.layout.slice("muscle_tension")
    muscles = MuscleModel(schema, TorqueBalance(gravity))
    posture = (theta - schema.scaler.mean[:2]) / schema.scaler.std[:2]
    tension = np.random.default_rng(4).uniform(10.0, 90.0, (50, 5))
    found = muscles.torque(np.tile(posture, (50, 1)), (tension - schema.scaler.mean[span]) / schema.scaler.std[span])
    wanted = tension @ arm.jacobian(theta)
    assert np.abs(found - wanted).mean() < 0.3  # N m, of torques of about 2 N m
    assert np.corrcoef(found.ravel(), wanted.ravel())[0, 1] > 0.98


def test_says_what_is_wrong(schema):
    with pytest.raises(NotObservable, match="give a target"):
        Match("joint_position").bind(schema, {}, {})
    with pytest.raises(NotFinite, match="reference of every element"):
        TorqueBalance(gravity).bind(schema, {"joint_position": np.array([0.0, np.nan])}, {})
    with pytest.raises(UnknownSignal, match="Known signals"):
        StaySmall("effort").bind(schema, {}, {})
    with pytest.raises(WrongSize, match="has 5 elements"):
        StayNear("muscle_length", value=(0.3,)).bind(schema, {}, {})
    blind = replace(schema, masks=(frozenset({"muscle_tension", "muscle_length"}),))
    with pytest.raises(NotObservable, match="does not infer it from"):
        TorqueBalance(gravity).bind(blind, TARGET, {})
