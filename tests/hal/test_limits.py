import numpy as np
import pytest
from hal_bench import description

from hal.config import RobotConfig
from hal.limits import Limiter

PERIOD = 0.005
CALM = {"muscle_tension": np.array([20.0, 20.0]), "muscle_length": np.array([0.3, 0.3]), "joint_position": np.zeros(1)}


def limiter(**limits):
    return Limiter(RobotConfig.model_validate(description(limits=limits)), PERIOD)


@pytest.fixture
def full():
    return limiter(
        muscle_length={"low": 0.1, "high": 0.5, "rate": 0.2},
        muscle_tension={"soft_high": 200, "trip_high": 400},
    )


def tense(*tension):
    return {**CALM, "muscle_tension": np.array(tension)}


def test_a_small_step_in_range_passes(full):
    before = np.array([0.3, 0.3])
    applied, limited = full.step(before + 0.0005, before, CALM)
    np.testing.assert_allclose(applied, before + 0.0005)
    assert limited == []


def test_any_step_is_at_most_the_rate(full):
    before = np.array([0.3, 0.3])
    applied, limited = full.step(np.array([0.5, 0.1]), before, CALM)
    np.testing.assert_allclose(applied - before, [0.001, -0.001])
    assert limited == ["rate"]


def test_a_command_is_cut_to_the_range(full):
    applied, limited = full.step(np.array([9.0, 0.3]), np.array([0.5, 0.3]), CALM)
    np.testing.assert_allclose(applied, [0.5, 0.3])
    assert limited == ["range"]


def test_without_limits_a_command_is_applied_as_it_is():
    applied, limited = limiter().step(np.array([9.0, -9.0]), np.array([0.3, 0.3]), CALM)
    np.testing.assert_array_equal(applied, [9.0, -9.0])
    assert limited == []


def test_what_is_held_is_not_pulled_into_range(full):
    before = np.array([0.52, 0.3])
    applied, limited = full.step(before, before, CALM, commanded=False)
    np.testing.assert_array_equal(applied, before)
    assert limited == []


@pytest.mark.parametrize(
    ("tension", "step"),
    [(100.0, -0.001), (180.0, -0.001), (190.0, -0.0005), (200.0, 0.0), (300.0, 0.0005), (400.0, 0.001), (900.0, 0.001)],
)
def test_a_tense_muscle_shortens_slower_rests_and_is_paid_out(full, tension, step):
    before = np.array([0.3, 0.3])
    applied, _ = full.step(np.array([0.1, 0.3]), before, tense(tension, 20.0))
    assert applied[0] - before[0] == pytest.approx(step, abs=1e-12)
    assert applied[1] == before[1]


def test_a_tense_muscle_may_lengthen_faster_by_command(full):
    before = np.array([0.3, 0.3])
    applied, limited = full.step(np.array([0.4, 0.3]), before, tense(250.0, 20.0))
    assert applied[0] - before[0] == pytest.approx(0.001)
    assert limited == ["rate"]


def test_paying_out_ends_at_the_longest_length(full):
    before = np.array([0.5, 0.3])
    applied, _ = full.step(before, before, tense(390.0, 20.0), commanded=False)
    assert applied[0] == 0.5


def test_an_unknown_tension_limits_nothing_and_is_told(full):
    before = np.array([0.3, 0.3])
    applied, _ = full.step(np.array([0.1, 0.1]), before, tense(np.nan, 20.0))
    np.testing.assert_allclose(applied - before, -0.001)
    assert full.blind(tense(np.nan, 20.0)) == ["biceps"]
    assert full.trip(tense(np.nan, 20.0)) is None


def test_trips_above_and_not_at_the_limit(full):
    assert full.trip(tense(400.0, 20.0)) is None
    assert "muscle_tension.triceps is 400.1" in full.trip(tense(20.0, 400.1))


def test_a_position_far_out_of_range_is_not_believed(full):
    assert full.misplaced(np.array([0.07, 0.53])) == []
    assert full.misplaced(np.array([0.05, 0.55])) == [0, 1]
    assert full.misplaced(np.array([np.nan, 0.3])) == []
    assert limiter().misplaced(np.array([-99.0, 99.0])) == []


def test_a_tense_muscle_comes_to_rest_at_the_limit_without_chatter(full):
    """A wire of 10 N/mm, pulled by a command that asks for far too much."""
    length, rest = 0.3, 0.31
    tensions = []
    before = np.array([length, 0.3])
    for _ in range(400):
        tension = max(0.0, (rest - before[0]) * 10_000)
        before, _ = full.step(np.array([0.1, 0.3]), before, tense(tension, 20.0))
        tensions.append(tension)
    assert max(tensions) <= 200.5
    assert np.ptp(tensions[-50:]) < 0.5
