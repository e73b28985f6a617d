"""Estimates beyond what was learned: along the line where the body is linear, by the network where it is not."""

from dataclasses import replace

import numpy as np
import pytest

from gemuco import BodySchema, TrainConfig, estimate, fit, load, save

SETTINGS = TrainConfig(hidden=(30,), latent=5, epochs=60, batch=50)
RATIO, OFFSET, RIPPLE = 2.5, 0.3, 0.005


def straight(motor: np.ndarray) -> np.ndarray:
    """Return two second encoders of motors [rad]: a gear that is a little out of round."""
    return RATIO * motor[:, :2] + OFFSET + RIPPLE * np.sin(4.0 * motor[:, :2])


def bent(motor: np.ndarray) -> np.ndarray:
    """Return the place of a tip [m], which bends with the joints."""
    return np.stack([np.sin(motor.sum(axis=1)), np.cos(motor[:, 0])], axis=1)


@pytest.fixture(scope="module")
def body() -> BodySchema:
    motor = np.random.default_rng(0).uniform(-1.0, 1.0, (1500, 2))
    data = {"motor": motor, "second": straight(motor), "tip": bent(motor)}
    schema, _ = fit(
        data, SETTINGS, [["motor"]], x_out=["second", "tip"], units={"motor": "rad", "second": "rad", "tip": "m"}
    )
    return schema


def far(distance: float) -> np.ndarray:
    """Return motor angles at a distance from the learned ones, to all sides [rad]."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    return (1.0 + distance) * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def by_network(schema: BodySchema, motor: np.ndarray, name: str) -> np.ndarray:
    rows = np.full((len(motor), schema.layout.size), np.nan)
    rows[:, schema.layout.slice("motor")] = motor
    rows[:, schema.out_index] = schema.infer(schema.scaler.normalise(rows), frozenset(["motor"]))
    return schema.scaler.restore(rows)[:, schema.layout.slice(name)]


@pytest.mark.parametrize("distance", [0.5, 2.0, 10.0])
def test_a_second_encoder_follows_the_line_far_beyond_the_learned_range(body, distance):
    motor = far(distance)
    seconds = estimate(body, {"motor": motor})["second"]
    assert set(seconds.state) == {"unknown"}
    away = 4.0 * RIPPLE * (1.0 + distance)  # the ripple turns the line a little
    assert np.abs(seconds.value - straight(motor)).max() < away
    assert np.abs(by_network(body, motor, "second") - straight(motor)).max() > 4.0 * away


@pytest.mark.parametrize("distance", [-0.9, -0.3, 0.5, 2.0])
def test_what_is_not_linear_is_left_to_the_network(body, distance):
    motor = far(distance)
    tips = estimate(body, {"motor": motor})["tip"].value
    np.testing.assert_allclose(tips, by_network(body, motor, "tip"), atol=1e-5)


def test_within_what_was_learned_the_network_predicts_alone(body):
    motor = far(-0.4)
    seconds = estimate(body, {"motor": motor})["second"]
    assert set(seconds.state) == {"known"}
    np.testing.assert_allclose(seconds.value, by_network(body, motor, "second"), atol=1e-5)


def test_the_estimate_has_no_step_where_the_learned_range_ends(body):
    motor = np.linspace([0.5, 0.0], [2.0, 0.0], 3001)
    step = np.diff(estimate(body, {"motor": motor})["second"].value[:, 0])
    np.testing.assert_allclose(step, RATIO * 5e-4, atol=4e-4)


def test_a_measured_signal_stays_as_it_is(body):
    motor = far(2.0)
    second = np.full((len(motor), 2), 0.125)
    second[:, 1] = np.nan
    value = estimate(body, {"motor": motor, "second": second})["second"].value
    assert (value[:, 0] == 0.125).all()
    np.testing.assert_allclose(value[:, 1], straight(motor)[:, 1], atol=4.0 * RIPPLE)


def test_a_saved_model_follows_the_same_line(body, tmp_path):
    save(body, tmp_path)
    values = {"motor": far(2.0)}
    np.testing.assert_array_equal(
        estimate(load(tmp_path), values)["second"].value, estimate(body, values)["second"].value
    )


def test_a_body_that_has_changed_is_not_estimated_by_the_former_line(body):
    last = body.weights.decoder[-1]
    shifted = last._replace(offset=last.offset + np.float32(0.5))
    changed = body.with_weights(replace(body.weights, decoder=(*body.weights.decoder[:-1], shifted)))
    motor = far(2.0)
    seconds = estimate(changed, {"motor": motor})["second"].value
    np.testing.assert_allclose(seconds, by_network(changed, motor, "second"), atol=1e-5)


def lifted(motor: np.ndarray) -> np.ndarray:
    """Return a second encoder whose gear another axis bends a little [rad]."""
    return RATIO * motor[:, :1] + OFFSET + 0.02 * motor[:, 2:]


def recorded(other: np.ndarray) -> BodySchema:
    """Return a model of one motion, in which another axis is the first one plus `other`, and the encoder drifts."""
    time, drift = np.arange(2000) / 100.0, 0.005 * np.sin(np.arange(2000) / 200.0)[:, None]
    first = np.sin(time / 1.5) + 0.3 * np.sin(2.7 * time)
    motor = np.stack([first, np.cos(1.1 * time), 0.95 * first + other], axis=1)
    units = {"motor": "rad", "second": "rad"}
    schema, _ = fit(
        {"motor": motor, "second": lifted(motor) + drift}, SETTINGS, [["motor"]], x_out=["second"], units=units
    )
    assert schema.path.by_few(np.ones(len(schema.in_index)), 0)[2] == 0.0
    return schema


def test_an_input_that_says_little_is_used_where_the_parts_of_the_data_agree_on_it():
    schema = recorded(0.31 * np.sin(np.arange(2000) / 61.0))
    asked = np.array([[1.5, 0.0, 0.95 * 1.5 + 0.3], [1.5, 0.0, 0.95 * 1.5 - 0.3], [-1.5, 0.0, -0.95 * 1.5 - 0.3]])
    seconds = estimate(schema, {"motor": asked})["second"]
    assert set(seconds.state) == {"unknown"}
    np.testing.assert_allclose(seconds.value, lifted(asked), atol=4e-3)


def test_an_input_that_follows_another_in_the_data_is_not_used_where_it_does_not():
    schema = recorded(0.002 * np.sin(np.arange(2000) / 61.0))
    asked = np.array([[1.5, 0.0, -1.5], [-1.5, 0.0, 1.5]])
    value = estimate(schema, {"motor": asked})["second"].value
    np.testing.assert_allclose(value, lifted(asked), atol=0.07)
