"""A value that does not follow from the others at standstill may change, and accuses no other of them."""

from dataclasses import replace

import numpy as np
import pytest

from gemuco.anomaly.healthy import learn_normal
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.trust.config import BLOCK
from gemuco.trust.monitor import TrustMonitor
from gemuco.trust.recent import SETTLING, Recent
from gemuco.trust.relations import Relations

SAMPLES, HALF = 5, 0.75
"""Samples in a block, and half of the track of the car [m]."""
NOISE = {"wheel_speed": 0.03, "yaw_rate": 0.004, "steering": 0.003}
UNITS = {"wheel_speed": "m/s", "yaw_rate": "rad/s", "steering": "rad"}
MASKS = [tuple(signal for signal in UNITS if signal != lost) for lost in UNITS]
LEFT, RIGHT, YAW, STEERING = range(4)
STANDS = slice(20, 50)
"""Of every 100 blocks the car stands in these, and its driver steers."""


def drive(blocks, seed):
    """Return what the sensors of a car measure, signal -> shape (blocks * SAMPLES, n)."""
    random, count = np.random.default_rng(seed), blocks * SAMPLES
    knots = np.arange(blocks // 10 + 2) * 10
    speed, steering = random.uniform(3.0, 15.0, len(knots)), random.normal(0.0, 0.1, len(knots))
    stands = (knots % 100 >= STANDS.start) & (knots % 100 <= STANDS.stop)
    speed[stands], steering[stands] = 0.0, random.normal(0.0, 0.3, stands.sum())
    at = np.arange(count) / SAMPLES
    speed, steering = np.interp(at, knots, speed), np.interp(at, knots, steering)
    yaw = speed * steering / 2.7
    true = {
        "wheel_speed": np.stack([speed - HALF * yaw, speed + HALF * yaw], axis=1),
        "yaw_rate": yaw[:, None],
        "steering": steering[:, None],
    }
    return {name: value + NOISE[name] * random.normal(size=value.shape) for name, value in true.items()}


@pytest.fixture(scope="module")
def model():
    config = TrainConfig(hidden=(40, 16), latent=4, epochs=60, batch=100)
    schema = fit([drive(1000, 1)], config, MASKS, units=UNITS)[0]
    return schema.with_normal(learn_normal(schema, schema.layout.join(drive(3000, 2))[::SAMPLES]))


def samples_of(model, blocks, seed):
    return model.layout.join(drive(blocks, seed)).reshape(blocks, SAMPLES, 4)


def hidden_in(model, samples):
    """Return the hidden elements after every block."""
    monitor, hidden = TrustMonitor(model), []
    for index, block in enumerate(model.scaler.normalise(samples)):
        monitor.add(block, index * BLOCK)
        hidden.append(monitor.hidden)
    return hidden


@pytest.mark.parametrize("seed", [11, *(pytest.param(seed, marks=pytest.mark.long) for seed in (12, 13, 14, 15))])
def test_a_driver_who_steers_at_standstill_is_no_lie(model, seed):
    assert not any(hidden_in(model, samples_of(model, 1000, seed)))


@pytest.mark.parametrize(
    ("element", "lie", "begin"),
    [(STEERING, 0.2, 460), (YAW, 0.1, 425), pytest.param(LEFT, 1.0, 460, marks=pytest.mark.long)],
)
def test_lies_are_found_where_a_value_follows_from_the_others(model, element, lie, begin):
    samples = samples_of(model, begin + 40, 21)
    samples[begin:, :, element] += lie
    hidden = hidden_in(model, samples)
    assert not any(hidden[:begin])
    assert element in hidden[begin + 20]


def test_at_standstill_one_value_that_moves_accuses_no_other(model):
    relations = Relations.of(model)
    recent = Recent(len(np.unique(relations.signals[: relations.count])))
    rest = np.tile(model.scaler.normalise(np.array([0.0, 0.0, 0.0, 0.05])), (SAMPLES, 1))
    for block in range(SETTLING + 10):
        rest[:, STEERING] += 0.2 * (block >= SETTLING)
        recent.add(model, relations, rest + 1e-3 * np.random.default_rng(block).normal(size=rest.shape))
        recent.rest(0.0, lambda distance: min(1.0, distance / 0.2))
    settled = recent.view(relations, frozenset()).settled
    assert recent.resting == 10
    assert np.isnan(settled[[LEFT, RIGHT, YAW]]).all()
    assert np.isnan(settled[STEERING]), "its own value does not follow from the posture either"
    usual = relations.without(frozenset())
    even = replace(usual, by_watch=usual.by_watch.even(4), by_network=usual.by_network.even(4))
    relations._kept[frozenset()] = even
    again = Recent(len(recent.lag))
    again.__dict__.update(recent.__dict__, _errors={})
    assert np.isfinite(again.view(relations, frozenset()).settled[STEERING])


def test_healthy_errors_are_expected_as_large_as_they_were_also_if_they_are_large(model):
    """Where a hidden element is far from its estimate, its error counts too."""
    relations = Relations.of(model)
    rows = model.normal.rows.astype(float)
    stands, features = np.abs(model.scaler.restore(rows[:, :4])[:, LEFT]) < 0.3, relations.features(rows)
    for hidden in (frozenset(), frozenset({STEERING})):
        errors, healthy, size, timing = relations.judged(model, hidden, features, relations._sensed, rows[:, :4])
        assert not timing.any()
        ratio = (errors / healthy)[:, STEERING]
        assert 0.5 < np.sqrt(np.mean(ratio[stands] ** 2)) < 1.2
        assert 0.3 < np.sqrt(np.mean(ratio[~stands] ** 2)) < 1.2
        assert np.median(size[stands, STEERING]) > 1.5 > np.median(size[~stands, STEERING])


SHAKE = 0.04
"""Misfit of the yaw rate in motion [rad/s]."""


def standing(blocks, random):
    """Return samples of a car that drives steadily from the start, with little noise, shape (blocks, SAMPLES, 4)."""
    yaw = 8.0 * 0.05 / 2.7
    true = np.array([8.0 - HALF * yaw, 8.0 + HALF * yaw, yaw, 0.05])
    return true + 0.01 * np.array([0.03, 0.03, 0.004, 0.003]) * random.normal(size=(blocks, SAMPLES, 4))


@pytest.mark.parametrize(("element", "lie"), [(YAW, 0.5), (LEFT, 2.0), (RIGHT, -3.0)])
def test_a_gross_jump_is_hidden_also_before_the_body_has_moved(model, element, lie):
    samples = standing(200, np.random.default_rng(element))
    samples[150:, :, element] += lie
    monitor, hidden = TrustMonitor(model), []
    for index, block in enumerate(model.scaler.normalise(samples)):
        monitor.add(block, index * BLOCK)
        hidden.append(monitor.hidden)
    assert not any(hidden[:150])
    assert hidden[155] == hidden[-1] == {element}
    assert monitor.findings[0].kind == "offset", "a value that stands still because the body does is not frozen"


@pytest.mark.parametrize("begin", [150, 155])
def test_the_first_motion_after_a_rest_is_no_burst_of_noise(model, begin):
    """Values of a fast motion do not fit each other as well within a block as those of a body at rest."""
    samples = samples_of(model, 260, 31)[60:]
    samples[:, :, YAW] += SHAKE * np.array([1.0, -1.0, 0.0, -1.0, 1.0])
    samples[:begin] = standing(begin, np.random.default_rng(5))
    assert not any(hidden_in(model, samples))


@pytest.mark.parametrize("other", [0.8, 1.2])
def test_a_body_that_moves_for_the_first_time_and_is_another_one_hides_none(model, other):
    samples = standing(200, np.random.default_rng(3))
    change = 8.0 * 0.3 / 2.7 * other  # another wheel base
    samples[150:] += np.array([-HALF * change, HALF * change, change, 0.3])
    assert not any(hidden_in(model, samples))
