"""All limits of a robot together: the muscles of the bench, which are commanded in length."""

import numpy as np
import pytest
from hal_bench import description

from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.safety.limiter import Limiter

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


def at(*length):
    return {**CALM, "muscle_length": np.array(length)}


def step(limits, desired, before, measured=CALM):
    """Set-point and the limits that acted, one cycle after `before`; None holds."""
    limits.start(at(*before))
    acted = limits.step(None if desired is None else np.array(desired), measured)
    return limits.set_point, acted


def test_a_small_step_in_range_passes_as_it_is(full):
    applied, limited = step(full, [0.3005, 0.3005], [0.3, 0.3])
    np.testing.assert_array_equal(applied, [0.3005, 0.3005])
    assert limited == []


def test_any_step_is_at_most_the_rate(full):
    applied, limited = step(full, [0.5, 0.1], [0.3, 0.3])
    np.testing.assert_allclose(applied - 0.3, [0.001, -0.001])
    assert limited == ["rate"]


def test_a_rate_may_be_one_per_element():
    each = limiter(muscle_length={"rate": [0.2, 0.4]})
    applied, _ = step(each, [0.5, 0.5], [0.3, 0.3])
    np.testing.assert_allclose(applied - 0.3, [0.001, 0.002])


def test_a_command_is_cut_to_the_range(full):
    applied, limited = step(full, [9.0, 0.3], [0.5, 0.3])
    np.testing.assert_allclose(applied, [0.5, 0.3])
    assert limited == ["range"]


def test_without_limits_a_command_is_applied_as_it_is():
    applied, limited = step(limiter(), [9.0, -9.0], [0.3, 0.3])
    np.testing.assert_array_equal(applied, [9.0, -9.0])
    assert limited == []


def test_what_is_held_is_not_pulled_into_range(full):
    applied, limited = step(full, None, [0.502, 0.3])
    np.testing.assert_array_equal(applied, [0.502, 0.3])
    assert limited == []


@pytest.mark.parametrize(
    ("tension", "way"),
    [(100.0, -0.001), (180.0, -0.001), (190.0, -0.0005), (200.0, 0.0), (300.0, 0.0005), (400.0, 0.001), (900.0, 0.001)],
)
def test_a_tense_muscle_shortens_slower_rests_and_is_paid_out(full, tension, way):
    applied, _ = step(full, [0.1, 0.3], [0.3, 0.3], tense(tension, 20.0))
    assert applied[0] - 0.3 == pytest.approx(way, abs=1e-12)
    assert applied[1] == 0.3


def test_a_tense_muscle_may_lengthen_faster_by_command(full):
    applied, limited = step(full, [0.4, 0.3], [0.3, 0.3], tense(250.0, 20.0))
    assert applied[0] - 0.3 == pytest.approx(0.001)
    assert limited == ["rate"]


def test_paying_out_ends_at_the_longest_length(full):
    applied, _ = step(full, None, [0.5, 0.3], tense(390.0, 20.0))
    assert applied[0] == 0.5


def test_an_unknown_tension_limits_nothing_and_is_told(full):
    applied, _ = step(full, [0.1, 0.1], [0.3, 0.3], tense(np.nan, 20.0))
    np.testing.assert_allclose(applied - 0.3, -0.001)
    assert full.blind(tense(np.nan, 20.0)) == "The tension limit cannot act without a valid tension of biceps."
    assert full.blind(CALM) == ""
    assert full.trip(tense(np.nan, 20.0)) == ""


def test_trips_above_and_not_at_the_limit(full):
    assert full.trip(tense(400.0, 20.0)) == ""
    assert "muscle_tension.triceps is 400.1, over its trip limit of 400." in full.trip(tense(20.0, 400.1))


def test_trips_below_too_and_on_any_signal():
    watched = limiter(muscle_tension={"trip_low": [2, 5]}, joint_position={"trip_low": -1, "trip_high": 1})
    assert watched.trip(tense(2.0, 5.0)) == ""
    assert "muscle_tension.triceps is 4.9, under its trip limit of 5." in watched.trip(tense(20.0, 4.9))
    assert "joint_position.elbow is 1.1, over" in watched.trip({**CALM, "joint_position": np.array([1.1])})
    assert "joint_position.elbow is -1.1, under" in watched.trip({**CALM, "joint_position": np.array([-1.1])})


def test_what_is_moved_far_out_of_its_range_trips(full):
    assert full.trip(at(0.085, 0.515)) == ""
    assert "muscle_length.biceps is 0.075, beyond its range of 0.1 to 0.5." in full.trip(at(0.075, 0.3))
    assert "muscle_length.triceps is 0.525, beyond" in full.trip(at(0.3, 0.525))


def test_limits_that_exclude_where_the_robot_is_are_told(full):
    assert full.excluded(at(0.093, 0.507)) == ""
    report = full.excluded(at(0.05, 0.55))
    assert "Far outside limits.muscle_length: biceps 0.05 (allowed: 0.1 to 0.5), triceps 0.55" in report
    assert "over its trip limit" in full.excluded(tense(500.0, 20.0))
    assert limiter().excluded(at(-99.0, 99.0)) == ""


def test_a_tense_muscle_comes_to_rest_at_the_limit_without_chatter(full):
    """A wire of 10 N/mm, pulled by a command that asks for far too much."""
    rest, tensions = 0.31, []
    full.start(CALM)
    for _ in range(400):
        tension = max(0.0, (rest - full.set_point[0]) * 10_000)
        full.step(np.array([0.1, 0.3]), tense(tension, 20.0))
        tensions.append(tension)
    assert max(tensions) <= 200.5
    assert np.ptp(tensions[-50:]) < 0.5


def test_two_signals_may_each_have_a_soft_limit():
    body = description(limits={"muscle_tension": {"soft_high": 200}, "muscle_force": {"soft_high": 50}})
    body["signals"]["muscle_force"] = {"unit": "N", "elements": ["triceps"]}
    both = Limiter(RobotConfig.model_validate({**body, "devices": {}}), PERIOD)
    measured = {**tense(300.0, 20.0), "muscle_force": np.array([75.0])}
    applied, _ = step(both, [0.3, 0.3], [0.3, 0.3], measured)
    assert (applied > 0.3).all()


@pytest.mark.parametrize(
    ("limits", "report"),
    [
        ({"muscle_length": {"soft_high": 1}}, "the signal is commanded"),
        ({"joint_position": {"soft_high": 1}}, "nothing to relax"),
    ],
)
def test_a_soft_limit_that_cannot_act_is_refused(limits, report):
    with pytest.raises(ConfigError, match=report):
        limiter(**limits)


@pytest.mark.parametrize(
    ("limits", "report"),
    [
        ({"muscle_length": {"low": 1, "high": 0}}, "low must be below high"),
        ({"muscle_length": {"low": 0.1, "trip_low": 0.2}}, "trip_low must be below low"),
        ({"muscle_length": {"high": 0.5, "trip_high": 0.5}}, "high must be below trip_high"),
        ({"muscle_tension": {"trip_low": 10, "trip_high": 5}}, "trip_low must be below trip_high"),
        ({"muscle_tension": {"soft_high": [300, 100], "trip_high": [400, 90]}}, "soft_high must be below trip_high"),
        ({"muscle_tension": {"trip_high": [1, 2, 3]}}, "trip_high has 3 values, the signal has 2"),
        ({"muscle_tension": {"rate": 3}}, "rate is of a command, but this signal is not the commanded one"),
        ({"joint_position": {"acceleration": 3}}, "acceleration is of a command"),
        ({"muscle_length": {"rate": [1, 2, 3]}}, "rate has 3 values"),
    ],
)
def test_limits_that_contradict_each_other_are_refused_at_load(limits, report):
    with pytest.raises(ValueError, match=report):
        RobotConfig.model_validate(description(limits=limits))


@pytest.mark.parametrize(
    ("stop", "report"),
    [
        ({"behaviour": "park"}, "needs a posture"),
        ({"behaviour": "park", "park": [0.3, 0.3]}, "and a `speed`"),
        ({"behaviour": "park", "park": [0.3], "speed": 0.1}, "stop.park has 1 values, muscle_length has 2"),
        ({"behaviour": "park", "park": [0.3, 0.9], "speed": 0.1}, "triceps 0.9 is outside of its limits, 0.1 to 0.5"),
        ({"behaviour": "off", "speed": 0.1}, "are for the behaviour park, not for 'off'"),
        ({"behaviour": "dance"}, "'hold', 'damp', 'park' or 'off'"),
    ],
)
def test_a_stop_that_does_not_fit_is_refused_at_load(stop, report):
    with pytest.raises(ValueError, match=report):
        RobotConfig.model_validate(description(stop=stop))


@pytest.mark.parametrize(("tension", "speed"), [(200.0, 0.0), (300.0, 0.1), (400.0, 0.2), (500.0, 0.2)])
def test_without_a_trip_limit_a_muscle_is_paid_out_fastest_at_twice_its_soft_limit(tension, speed):
    soft = limiter(muscle_length={"low": 0.1, "high": 0.5, "rate": 0.2}, muscle_tension={"soft_high": 200})
    applied, _ = step(soft, [0.3, 0.3], [0.3, 0.3], tense(tension, 20.0))
    np.testing.assert_allclose(applied, [0.3 + speed * PERIOD, 0.3])


@pytest.mark.parametrize(
    ("bounds", "rate", "speed"), [({"low": 0.1, "high": 0.5}, None, 0.4), ({}, None, 1.0), ({}, 0.2, 0.2)]
)
def test_without_a_rate_a_muscle_is_paid_out_by_its_range_per_second_or_one_unit(bounds, rate, speed):
    length = {**bounds, **({"rate": rate} if rate else {})}
    soft = limiter(**({"muscle_length": length} if length else {}), muscle_tension={"soft_high": 200, "trip_high": 400})
    applied, _ = step(soft, [0.3, 0.3], [0.3, 0.3], tense(400.0, 20.0))
    np.testing.assert_allclose(applied, [0.3 + speed * PERIOD, 0.3])


@pytest.mark.parametrize(
    ("length", "is_excluded", "trips"),
    [
        (0.0925, False, False),
        (0.0915, True, False),
        (0.0805, True, False),
        (0.0795, True, True),
        (0.5075, False, False),
        (0.5085, True, False),
        (0.5195, True, False),
        (0.5205, True, True),
    ],
)
def test_a_robot_starts_within_2_percent_beyond_its_range_and_stops_beyond_5(full, length, is_excluded, trips):
    """Of a range of 0.4 m."""
    assert bool(full.excluded(at(length, 0.3))) is is_excluded
    assert bool(full.trip(at(length, 0.3))) is trips
