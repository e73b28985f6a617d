from dataclasses import replace

import numpy as np
import pytest

from gemuco.adaption.adapt import adapt
from gemuco.anomaly.score import score
from gemuco.controller import control
from gemuco.errors import SchemaError, UnknownSignal, WrongSize
from gemuco.estimation import estimate
from gemuco.learning.train import TrainConfig, fit
from gemuco.simulation import simulate

FL = frozenset({"muscle_tension", "muscle_length"})


@pytest.fixture(scope="module")
def fresh(arm):
    return arm.sample(300, 4242)


def row(values, index):
    return {name: array[index].copy() for name, array in values.items()}


def test_measured_values_pass_through(schema, fresh):
    values = row(fresh, 0)
    for name, found in estimate(schema, values).items():
        np.testing.assert_array_equal(found.value, values[name])
        assert (found.method, found.residual) == ("measured", 0.0)
        assert not found.estimated.any()
        assert not found.std.any()


def test_absent_joints_are_estimated_by_a_mask(schema, fresh):
    errors, claimed = [], []
    for index in range(200):
        values = row(fresh, index)
        truth = values.pop("joint_position")
        found = estimate(schema, values)["joint_position"]
        assert (found.method, found.mask) == ("mask", FL)
        assert found.estimated.all()
        errors.append(found.value - truth)
        claimed.append(found.std)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (rms < 0.08).all()  # rad
    np.testing.assert_allclose(np.mean(claimed, axis=0), rms, rtol=0.5)


def test_one_missing_element_leaves_the_others_measured(schema, fresh):
    values = row(fresh, 3)
    truth = values["joint_position"][1]
    values["joint_position"][1] = np.nan
    found = estimate(schema, values)["joint_position"]
    assert found.estimated.tolist() == [False, True]
    assert found.value[0] == values["joint_position"][0]
    assert found.value[1] == pytest.approx(truth, abs=0.25)
    assert found.std[0] == 0.0 < found.std[1]


def test_infinite_counts_as_missing(schema, fresh):
    values = row(fresh, 3)
    values["joint_position"][1] = np.inf
    assert estimate(schema, values)["joint_position"].estimated.tolist() == [False, True]


def test_without_a_feasible_mask_it_searches_the_latent_space(schema, fresh):
    values = row(fresh, 5)
    truth = values.pop("muscle_length")
    values["muscle_tension"][0] = np.nan
    found = estimate(schema, values)
    assert found["muscle_length"].method == "latent"
    assert np.abs(found["muscle_length"].value - truth).max() < 0.05  # m
    assert found["muscle_length"].residual < 0.3  # standard deviations
    assert np.isfinite(found["muscle_length"].std).all()
    assert found["muscle_tension"].estimated.tolist() == [True, False, False, False, False]


@pytest.fixture(scope="module")
def inverse(arm):
    """Lengths from joints and tensions, and nothing else."""
    config = TrainConfig(hidden=(60, 20), latent=7, epochs=40, batch=100)
    return fit(arm.episodes(8, 200), config, [{"joint_position", "muscle_tension"}], x_out=["muscle_length"])[0]


def test_a_signal_that_is_only_an_input_is_sought_there(inverse, fresh):
    errors, claimed = [], []
    for index in range(20):
        values = row(fresh, index)
        truth = values.pop("joint_position")
        found = estimate(inverse, values)["joint_position"]
        assert found.method == "input"
        errors.append(found.value - truth)
        claimed.append(found.std)
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.3  # rad
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (rms < 2.0 * np.mean(claimed, axis=0)).all()
    assert (np.mean(claimed, axis=0) < 2.0 * rms).all()


def test_one_element_that_is_only_an_input_is_sought_beside_the_others(inverse, fresh):
    values = row(fresh, 1)
    truth = values["joint_position"][1]
    values["joint_position"][1] = np.nan
    found = estimate(inverse, values)["joint_position"]
    assert found.estimated.tolist() == [False, True]
    assert found.value[1] == pytest.approx(truth, abs=0.15)


def test_the_residual_of_a_latent_search_tells_a_body_that_does_not_exist(schema, fresh):
    """Lengths far from any that were trained on are fitted by some z, but by no body."""
    values = row(fresh, 5)
    values.pop("muscle_tension")
    values.pop("joint_position")
    usual = estimate(schema, values)["joint_position"]
    values["muscle_length"] = values["muscle_length"] + np.array([0.08, 0.08, -0.08, 0.08, -0.08])
    strange = estimate(schema, values)["joint_position"]
    assert usual.method == strange.method == "latent"
    assert strange.residual > 3 * usual.residual


def test_nothing_at_all_is_none(schema):
    for found in estimate(schema, {}).values():
        assert found.method == "none"
        assert np.isnan(found.value).all()
        assert np.isnan(found.residual)
        assert not found.estimated.any()


def test_a_signal_the_network_does_not_know_is_none(schema, fresh):
    masks = (frozenset({"joint_position"}),)
    config = TrainConfig(hidden=(10,), latent=4, epochs=1)
    small, _ = fit(_dataset_of(fresh, schema), config, masks, x_out=["muscle_length"])
    values = row(fresh, 0)
    values.pop("muscle_tension")
    assert estimate(small, values)["muscle_tension"].method == "none"


def _dataset_of(values, schema):
    from gemuco.dataset import Dataset, Episode

    return Dataset(schema.layout, (Episode("new", values),))


def test_says_what_is_wrong(schema):
    with pytest.raises(UnknownSignal, match="Known signals"):
        estimate(schema, {"joint_torque": np.zeros(2)})
    with pytest.raises(WrongSize, match="has 2 elements"):
        estimate(schema, {"joint_position": np.zeros(3)})
    with pytest.raises(SchemaError, match="the layout needs"):
        replace(schema, x_out=("joint_position",))


def test_several_samples_at_once_are_refused(schema, arm):
    many = arm.sample(3, 0)
    posture = {"joint_position": many["joint_position"][0]}
    questions = (
        lambda values: score(schema, values),
        lambda values: adapt(schema, [values]),
        lambda values: control(schema, posture, values, command="muscle_length"),
        lambda values: simulate(schema, [many["muscle_length"][0]], command="muscle_length", now=values),
    )
    for ask in questions:
        with pytest.raises(WrongSize, match="One sample at a time"):
            ask(many)
    with pytest.raises(WrongSize, match="it is one array"):
        control(schema, {"joint_position": many["joint_position"]}, command="muscle_length")


def test_nothing_in_it_can_be_changed(schema):
    with pytest.raises(ValueError, match="read-only"):
        schema.weights.encoder[0].matrix[0, 0] = 1.0
    with pytest.raises(AttributeError):
        schema.masks = ()
