"""The tests of single errors: steps, their age across gaps, and noise."""

import numpy as np
import pytest

from gemuco.trust.changes import AGES, FAINT, LONGEST, LastingTest, Likeness, StepTest
from gemuco.trust.evidence import Judge, burst
from gemuco.trust.healthy import NOISE_KNOWN, Healthy
from gemuco.trust.recent import NOISY, View, _noise

MOVING = np.arange(LONGEST, dtype=float)
"""Motion up to each block of a body that moves at its usual pace."""


def test_a_step_is_tested_with_its_likeness():
    """A healthy slow error passes; the deviation of a step is that of the likelihood ratio of normal variables."""
    likeness = Likeness(np.array([0.9]), np.array([0.1]))
    random, lag = np.random.default_rng(0), np.abs(np.subtract.outer(np.arange(LONGEST), np.arange(LONGEST)))
    covariance = 0.9 * 0.9**lag + 0.1 * np.eye(LONGEST)
    healthy = np.linalg.cholesky(covariance) @ random.normal(size=(LONGEST, 2000))
    test = StepTest(likeness)
    deviations = np.array([test(column[:, None], MOVING)[0][0] for column in healthy.T])
    assert 0.9 < np.sqrt(np.mean(deviations**2)) < 2.5  # the largest of eight ages
    step = np.where(np.arange(LONGEST) >= LONGEST - 5, 3.0, 0.0)
    found, age = test(step[:, None], MOVING)
    expected = np.sqrt(step @ np.linalg.inv(covariance) @ step)
    assert found[0] == pytest.approx(expected, rel=1e-6)
    assert (1, 2, 3, 5)[age[0]] == 5


@pytest.mark.parametrize(("gain", "is_wrong"), [(-2.0, True), (0.6, True), (0.0, False)])
def test_errors_that_change_their_sign_with_the_prediction_add_up(gain, is_wrong):
    """A reversed sign or a wrong gain is wrong both ways in turn; sums of one way only forget it at each turn."""
    random, test = np.random.default_rng(5), LastingTest(1)
    for block in range(200):
        predicted = np.array([1.2 * np.sin(0.15 * block)])
        z = gain * predicted / 0.2 + random.normal(size=1)
        test.add(z, predicted, np.full(1, 3.0), np.full(1, 0.2))
    assert (test.likelihood[0] > 25.0) == is_wrong


@pytest.mark.parametrize(("first", "last"), [(0, LONGEST - 3), (5, 20), (LONGEST - 4, LONGEST - 1)])
def test_an_error_after_a_gap_is_no_step(first, last):
    count, lag = 4000, np.abs(np.subtract.outer(np.arange(LONGEST), np.arange(LONGEST)))
    healthy = np.linalg.cholesky(0.9 * 0.9**lag + 0.1 * np.eye(LONGEST)) @ np.random.default_rng(1).normal(
        size=(LONGEST, count)
    )
    test = StepTest(Likeness(np.full(count, 0.9), np.full(count, 0.1)))
    usual = np.quantile(test(healthy, MOVING)[0], 0.999)
    healthy[first:last] = np.nan
    assert np.quantile(test(healthy, MOVING)[0], 0.999) < 1.05 * usual


@pytest.mark.long
def test_errors_at_one_posture_say_the_same_again_and_again():
    """At rest a healthy error stays; the step test must not take 30 equal errors for 30 witnesses."""
    random, count = np.random.default_rng(2), 20_000
    test = StepTest(Likeness(np.full(count, 0.9), np.full(count, 0.05)))
    slow = np.sqrt(0.95) * random.normal(size=count)
    resting = slow + np.sqrt(0.05) * random.normal(size=(LONGEST, count))
    arrived = np.minimum(MOVING, 2.0)  # it has moved for two blocks, and then rests
    assert np.quantile(test(resting, arrived)[0], 0.999) < 4.5 < np.quantile(test(resting, MOVING)[0], 0.999)
    jump = resting.copy()
    jump[-5:] += 12.0
    assert np.median(test(jump, arrived)[0]) == pytest.approx(np.median(test(jump, MOVING)[0]), rel=0.15)


@pytest.mark.parametrize("gaps", [False, True])
def test_a_column_is_judged_alone_as_among_others_that_are_quiet(gaps):
    """The smaller of two deviations is computed for large ones only, and never for the wrong column."""
    random, arrived = np.random.default_rng(3), np.minimum(MOVING, 12.0)
    likeness = Likeness(random.uniform(0.5, 0.95, 12), random.uniform(0.1, 0.9, 12))
    z = random.normal(size=(LONGEST, 12))
    z[-6:, 4:] += random.normal(size=8) * 6.0
    if gaps:
        z[3:9, 2:6] = z[20:22, 5:8] = np.nan
    together, ages = StepTest(likeness)(z, arrived)
    for column in range(12):
        own = Likeness(likeness.slow[[column]], likeness.white[[column]])
        both = [StepTest(own)(z[:, [column]], moved) for moved in (MOVING, arrived)]
        alone, age = StepTest(own)(z[:, [column]], arrived)
        assert together[column] == pytest.approx(alone[0]) and ages[column] == age[0]
        assert together[column] <= min(each[0][0] for each in both) + 1e-9 or together[column] < FAINT


def test_the_age_of_a_step_is_found_across_a_gap():
    test = StepTest(Likeness(np.full(2, 0.3), np.full(2, 0.9)))
    z = np.zeros((LONGEST, 2))
    z[-8:] = 3.0
    z[-4:-2, 1] = np.nan
    strength, best = test(z, MOVING)
    assert (np.array(AGES)[best] == 8).all()
    assert strength[1] == pytest.approx(strength[0] * np.sqrt(6 / 8), rel=0.05)
    assert test(np.full((LONGEST, 2), np.nan), MOVING)[0] == pytest.approx(0.0)


def test_the_usual_noise_of_an_element_is_that_since_it_is_measured():
    """An encoder that was lost at the start and returns is not called noisy for its usual noise."""
    healthy, random = Healthy(2), np.random.default_rng(4)
    for block in range(400):
        noise = 0.9 * random.chisquare(3, 2) / 3
        noise[1] = np.nan if block < 200 else noise[1]
        healthy.add(np.zeros((LONGEST, 2)), np.zeros(2), noise, 1.0)
        assert healthy.noise[0] == (np.inf if block < NOISE_KNOWN - 1 else pytest.approx(0.9, abs=0.5))
        if block < 200 + NOISE_KNOWN - 1:
            assert healthy.noise[1] == np.inf
        else:
            assert healthy.noise[1] == pytest.approx(0.9, abs=0.5)


def test_what_a_fast_motion_shows_is_no_noise_after_a_rest():
    healthy, nothing = Healthy(1), (np.zeros((LONGEST, 1)), np.zeros(1))
    for _ in range(100):
        healthy.add(*nothing, np.full(1, 1e-3), 0.0)
    assert healthy.noise[0] == pytest.approx(1e-3, rel=0.1)
    for block in range(60):
        healthy.add(*nothing, np.full(1, 0.5), 1.0)
        assert block >= NOISE_KNOWN - 1 or healthy.noise[0] == np.inf, "that of motion is not known yet"
    for _ in range(6000):
        healthy.add(*nothing, np.full(1, 1e-3), 0.0)
    assert healthy.noise[0] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(("share", "is_noise"), [(0.6, False), (0.8, True)])
def test_noise_matters_from_a_share_of_the_size_on(share, is_noise):
    healthy = Healthy(2)
    for _ in range(100):
        healthy.add(np.ones((LONGEST, 2)), np.zeros(2), np.full(2, 1e-3), 1.0)
    size = 3.0
    judge = Judge(healthy, 0.006, np.full(2, size))
    noises = np.array([[(share * size) ** 2, 1e-3]] * 5) * judge.scale**2
    unknown, none = np.full(2, np.nan), np.zeros((LONGEST, 2))
    evidence = judge(View(none, none + 1.0, none, none[:1], noises, frozenset(), unknown, np.zeros(2), MOVING, 20))
    assert evidence.is_noise.tolist() == [is_noise, False]
    assert (evidence.ratio[0] >= 1.0) == is_noise


@pytest.mark.parametrize("samples", [5, 20])
def test_healthy_noise_is_a_burst_as_rarely_as_was_asked_for(samples):
    """Of few samples the variance is less sure, and healthy noise reached a fixed multiple of it once in a minute."""
    random, chance = np.random.default_rng(samples), 1e-3
    features = random.normal(size=(4000, NOISY, samples, 3))
    features[..., 0] = 1.0
    maps = np.array([[0.0], [1.0], [-1.0]])  # measured minus predicted, which have the same noise
    noises = np.array([[_noise(block, maps)[0] for block in window] for window in features])
    usual, median = noises.mean(), np.median(noises, axis=1)
    assert (median > burst(samples, chance) * usual).mean() < 3.0 * chance
    assert (median > 0.5 * burst(samples, chance) * usual).mean() > chance
