from dataclasses import replace

import numpy as np
import pytest

from gemuco import TrainConfig, estimate, fit
from gemuco.adaption.gradient import gates
from gemuco.adaption.innovation import Innovations
from gemuco.anomaly.prediction import judges, prediction_errors
from gemuco.compiled.batch import under_masks
from gemuco.compiled.score import errors
from gemuco.layers import run

MOTOR, MIXED = frozenset({"motor"}), frozenset({"motor", "current"})
UNITS = {"motor": "rad", "encoder": "rad", "height": "m", "current": "A"}


def body(count: int, seed: int, reach: float = 1.0) -> dict[str, np.ndarray]:
    """An arm with a second encoder, which is linear; the height of its tip, which is not; and a useless current."""
    random = np.random.default_rng(seed)
    motor = random.uniform(-reach, reach, (count, 2))
    encoder = motor @ np.array([[0.5, 0.1], [-0.2, 0.8]]) + 1e-4 * random.standard_normal((count, 2))
    height = np.sin(2.0 * motor[:, :1]) + 0.5 * np.cos(2.0 * motor.sum(axis=1, keepdims=True))
    return {"motor": motor, "encoder": encoder, "height": height, "current": random.standard_normal((count, 1))}


@pytest.fixture(scope="module")
def schema():
    config = TrainConfig(hidden=(30,), latent=8, epochs=60, batch=50)
    episodes = [body(100, seed) for seed in range(8)]
    masks = [MOTOR, {"encoder"}, MIXED, {"encoder", "current"}]
    return fit(episodes, config, masks, x_out=["encoder", "height"], units=UNITS)[0]


def test_what_is_linear_is_as_exact_as_a_regression_also_outside(schema):
    shares = schema.out_layout.split(schema.shares[MIXED])
    assert not shares["encoder"].any() and shares["height"].all()
    for reach, tolerance in ((1.0, 1e-3), (5.0, 5e-3)):  # rad
        fresh = body(200, 100, reach)
        estimated = estimate(schema, {"motor": fresh["motor"], "current": fresh["current"]})["encoder"].value
        assert np.abs(estimated - fresh["encoder"]).max() < tolerance


def test_what_is_not_linear_is_left_to_the_network(schema):
    fresh = body(200, 101)
    prediction = estimate(schema, {"motor": fresh["motor"]})["height"].value
    line = np.linalg.lstsq(np.c_[fresh["motor"], np.ones(200)], fresh["height"], rcond=None)[0]
    missed = np.sqrt(np.mean((prediction - fresh["height"]) ** 2))
    assert missed < 0.3 * np.sqrt(np.mean((np.c_[fresh["motor"], np.ones(200)] @ line - fresh["height"]) ** 2))


def test_of_equal_masks_the_one_without_useless_signals_is_used(schema):
    fresh = body(1, 102)
    given = {"motor": fresh["motor"][0], "current": fresh["current"][0]}
    assert estimate(schema, given)["encoder"].mask == MOTOR


@pytest.fixture(scope="module")
def mixed(schema):
    return replace(schema, shares={mask: np.array([0.0, 0.5, 0.7]) for mask in schema.masks})


def test_every_way_to_the_output_mixes_alike(mixed):
    rows = mixed.normalise(body(6, 103))
    for mask in mixed.masks:
        expected = mixed.infer(rows, mask)
        network = run(mixed.weights.whole, mixed.network_input(rows, mask))
        assert np.abs(expected - network).max() > 1e-6
        np.testing.assert_allclose(run(mixed.chain(mask), mixed.network_input(rows, mask)), expected, atol=1e-5)
        given = mixed.layout.split(mixed.scaler.restore(rows[0]))
        one = estimate(mixed, {name: given[name] for name in mask})
        height = mixed.scaler.normalise(np.append(np.zeros(4), [*one["height"].value, 0.0]))[4]
        np.testing.assert_allclose(height, mixed.infer(rows[0], one["height"].mask)[2], atol=1e-5)


def test_errors_and_innovations_mix_alike(mixed):
    rows = mixed.normalise(body(4, 104))
    for row in rows:
        joined = mixed.scaler.restore(row)
        compiled = errors(mixed.predictor, mixed.derived(judges), joined)
        np.testing.assert_allclose(compiled, prediction_errors(mixed, row), atol=1e-5)
    innovations = Innovations(mixed)
    pairs = innovations.pairs(np.ones(mixed.layout.size, bool))
    white, _ = innovations.of(mixed, pairs, rows, np.zeros((len(rows), 0)))
    table = np.concatenate([rows[:, mixed.out_index] - mixed.infer(rows, mask) for mask in pairs.masks], axis=1)
    np.testing.assert_allclose(white, table[:, pairs.index] @ pairs.whiten.T, rtol=1e-3, atol=1e-3)


def test_the_network_learns_what_the_line_leaves(mixed):
    rows = mixed.normalise(body(5, 105)).astype(np.float32)
    inputs, targets, weights, origin = under_masks(rows, np.zeros((5, 0), np.float32), *gates(mixed), mixed.predictor)
    prediction = run(mixed.weights.whole, inputs)
    assert np.isnan(targets[:, 0]).all()
    share = np.array([0.5, 0.7])
    masks = np.repeat(np.arange(len(mixed.masks)), 5)
    for line, (mask, row) in enumerate(zip(masks, origin, strict=True)):
        missed = rows[row, mixed.out_index] - mixed.infer(rows[row], mixed.masks[mask])
        np.testing.assert_allclose((targets[line] - prediction[line])[1:] * share, missed[1:], atol=1e-4)
        np.testing.assert_allclose(weights[line], [0.0, *share**2], rtol=1e-6)
