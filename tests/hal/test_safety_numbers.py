"""Limits, watchdogs, start and emergency stop of the safety bench in numbers, by arithmetic done by hand."""

import math
import threading
import time

import numpy as np
import pytest
from hal_bench import description as muscles
from safety_bench import PERIOD, SafetyBench, description

from hal.config import RobotConfig
from hal.errors import CommandRefused
from hal.safety.cycle_lock import CycleLock
from hal.safety.limit import fastest
from hal.safety.limiter import Limiter
from hal.safety.start import Start
from hal.safety.watchdog import CommandWatchdog, CycleWatchdog, checked


def limiter(quantity, stale_after=0.05, **limits):
    bench = SafetyBench(quantity)
    body = description(quantity)
    body["signals"]["joint_position"]["stale_after"] = stale_after
    body["limits"] = {**body["limits"], **limits}
    made = Limiter(RobotConfig.model_validate(body), PERIOD, bench.joints, quantity)
    made.start(measured())
    return made


def measured(position=0.0, velocity=0.0, effort=0.0):
    return {
        "joint_position": np.array([position, 0.0]),
        "joint_velocity": np.array([velocity, 0.0]),
        "joint_effort": np.array([effort, 0.0]),
        "joint_temperature": np.zeros(2),
    }


def step(limits, wanted, before, **values):
    """The set-point of the shoulder one cycle after `before`, and the limits that acted."""
    limits.set_point = np.array([before, 0.0])
    acted = limits.step(None if wanted is None else np.array([wanted, 0.0]), measured(**values))
    return float(limits.set_point[0]), acted


@pytest.mark.parametrize(
    ("stale_after", "position", "wanted", "allowed"),
    [
        # the oldest position is 0.05 s + 2 cycles of 5 ms + 0.02 s old, and the way may be gone in twice that time
        (0.05, 1.9, 1.0, 0.1 / 0.16),
        (0.05, -0.9, -1.0, -0.1 / 0.16),
        (0.09, 1.9, 1.0, 0.1 / 0.24),
        (0.05, 1.9, -1.0, -1.0),
        (0.05, 0.0, 1.0, 1.0),
    ],
)
def test_a_velocity_by_the_age_of_the_position(stale_after, position, wanted, allowed):
    limits = limiter("velocity", stale_after, joint_velocity={"low": -1, "high": 1})
    found, acted = step(limits, wanted, 0.0, position=position)
    assert found == pytest.approx(allowed)
    assert acted == ([] if found == wanted else ["range"])


def test_a_velocity_with_a_rate():
    """Rate 5 rad/s2: 0.025 rad/s per cycle, and a deceleration before the end of the range."""
    limits = limiter("velocity")
    assert step(limits, 1.0, 0.5) == (pytest.approx(0.525), ["rate"])
    assert step(limits, None, 0.5) == (pytest.approx(0.475), ["rate"])
    assert step(limits, 5.0, 0.99) == (pytest.approx(1.0), ["range"])
    expected = 5.0 * (math.sqrt(0.16**2 + 2 / 5.0 * 0.1) - 0.16)
    assert step(limits, 0.9, 0.9, position=1.9) == (pytest.approx(expected), ["range"])


def test_an_effort():
    """Range -2 to 2 N m, rate 100 N m/s; it fades out in 0.3 rad before an end and in 0.6 rad/s before 3 rad/s."""
    limits = limiter("effort")
    assert step(limits, 9.0, 1.9) == (pytest.approx(2.0), ["range"])
    assert step(limits, 2.0, 0.0) == (pytest.approx(0.5), ["rate"])
    assert step(limits, 2.0, 2.0, position=1.85) == (pytest.approx(1.0), ["range"])
    assert step(limits, 2.0, 2.0, velocity=2.7) == (pytest.approx(1.0), ["velocity"])
    assert step(limits, -2.0, -2.0, velocity=-2.7) == (pytest.approx(-1.0), ["velocity"])
    assert step(limits, None, 0.4) == (0.0, [])
    limits = limiter("effort", joint_effort={"low": -2, "high": 2, "soft_high": 1.0})
    assert step(limits, 2.0, 1.0, effort=1.05) == (pytest.approx(0.99), ["effort"])


def test_a_velocity_that_relieves_is_the_slower_end_of_its_range():
    for bounds, speed in (({"low": -0.5, "high": 2}, 0.5), ({"low": -2, "high": 0.25}, 0.25), ({}, 1.0)):
        limits = limiter("velocity", joint_velocity=bounds, joint_effort={"soft_high": 5.0, "trip_high": 10.0})
        assert step(limits, 0.0, 0.0, effort=-10.0) == (pytest.approx(speed), ["effort"])
        assert step(limits, 0.0, 0.0, effort=10.0) == (pytest.approx(-speed), ["effort"])
        assert step(limits, 0.1, 0.0, effort=2.0) == (0.1, [])


def test_the_start_of_each_quantity():
    for quantity in ("velocity", "effort"):
        assert limiter(quantity).start(measured(1.0, 2.0, 3.0)).tolist() == [0.0, 0.0]
    limits = limiter("position")
    limits.set_point = np.array([0.7, 0.7])
    known = {**measured(), "joint_position": np.array([np.nan, 1.5])}
    assert limits.start(known).tolist() == [0.7, 1.5]
    limits.step(np.array([2.0, 2.0]), measured())
    assert limits._speed.any()
    limits.start(measured())
    assert not limits._speed.any()


def test_an_acceleration_and_a_rate_of_a_position():
    """10 rad/s2: 0.05 rad/s faster per cycle of 5 ms, up to 1 rad/s."""
    limits = limiter("position")
    ways = []
    for _ in range(30):
        before = limits.set_point[0]
        acted = limits.step(np.array([2.0, 0.0]), measured())
        ways.append((limits.set_point[0] - before) / PERIOD)
        assert "acceleration" in acted
    assert ways == pytest.approx([min(0.05 * number, 1.0) for number in range(1, 31)])


@pytest.mark.parametrize(
    ("distance", "speed"),
    [(1e-5, 0.002), (2.4e-5, 0.0048), (2.5e-5, 0.005), (1e-4, 1e-4 / 0.015 + 0.005), (0.0, 0.0), (-1.0, 0.0)],
)
def test_the_fastest_speed_within_a_distance(distance, speed):
    """1 unit/s2 in cycles of 5 ms: a loss of 5 mm/s per cycle; 0.1 mm takes three cycles."""
    assert fastest(np.array([distance]), 1.0, PERIOD)[0] == pytest.approx(speed)


def muscle(tension, length=0.3, **limits):
    """The set-point of a muscle, one cycle after its length, and the limits that acted."""
    made = Limiter(RobotConfig.model_validate(muscles(limits=limits)), PERIOD)
    known = {
        "muscle_tension": np.array([tension, 20.0]),
        "muscle_length": np.array([length, 0.3]),
        "joint_position": np.zeros(1),
    }
    made.start(known)
    made.step(None, known)
    return float(made.set_point[0])


def test_paying_out_with_a_deceleration_ends_at_the_end():
    """At 400 N by 0.2 m/s, but 0.1 mm before the end no faster than can be braked by 1 m/s2."""
    length = {"low": 0.1, "high": 0.5, "rate": 0.2, "acceleration": 1.0}
    tension = {"soft_high": 200, "trip_high": 400}
    assert muscle(400.0, muscle_length=length, muscle_tension=tension) == pytest.approx(0.3 + 0.2 * PERIOD)
    at_end = muscle(400.0, 0.4999, muscle_length=length, muscle_tension=tension)
    assert at_end == pytest.approx(0.4999 + (1e-4 / 0.015 + 0.005) * PERIOD)
    short = {"low": 0.1, "high": 0.35, "rate": 9.0}
    assert muscle(400.0, muscle_length=short, muscle_tension=tension) == pytest.approx(0.3 + 0.25 * PERIOD)


def test_parking_has_a_speed_of_its_own():
    stop = {"behaviour": "park", "park": [0.3, 0.3], "speed": 0.04}
    limits = {
        "muscle_length": {"low": 0.1, "high": 0.5, "rate": 0.2},
        "muscle_tension": {"soft_high": 200, "trip_high": 400},
    }
    made = Limiter(RobotConfig.model_validate(muscles(limits=limits, stop=stop)), PERIOD)
    known = {
        "muscle_tension": np.array([20.0, 400.0]),
        "muscle_length": np.array([0.4, 0.4]),
        "joint_position": np.zeros(1),
    }
    made.start(known)
    assert made.step(np.array([0.3, 0.3]), known, is_parking=True) == ["rate", "tension"]
    assert made.set_point == pytest.approx([0.4 - 0.04 * PERIOD, 0.4 + 0.2 * PERIOD])
    made.start(known)
    assert made.step(np.array([9.0, 0.3]), known, is_parking=True) == ["range", "rate", "tension"]
    made.start(known)
    made.step(np.array([0.3, 0.3]), known)
    assert made.set_point[0] == pytest.approx(0.4 - 0.2 * PERIOD)


def start():
    bench = SafetyBench("position")
    return Start(bench.config, "position"), Limiter(bench.config, PERIOD, bench.joints)


@pytest.mark.parametrize(("waited", "is_known"), [(0.25, True), (0.2501, False)])
def test_a_start_position_is_remembered_for_a_quarter_of_a_second(waited, is_known):
    begin, limits = start()
    with pytest.raises(CommandRefused, match="No valid joint_position of shoulder, elbow"):
        begin.check(10.0, limits)
    begin.note(measured(0.3), 10.0)
    begin.note(measured(math.nan), 10.0 + waited)
    if is_known:
        begin.check(10.0 + waited, limits)
    else:
        with pytest.raises(CommandRefused, match="No valid joint_position of shoulder, so"):
            begin.check(10.0 + waited, limits)
    assert begin.known["joint_position"][0] == 0.3


def test_a_start_position_is_the_median_of_three():
    begin, _ = start()
    for cycle, value in enumerate((0.1, 0.9, 0.2, 0.3)):
        begin.note(measured(value), 10.0 + cycle * PERIOD)
    assert begin.median()["joint_position"][0] == pytest.approx(0.3)
    begin.note(measured(0.25), 10.3)  # measurements from before a gap are not used
    assert begin.median()["joint_position"][0] == 0.25


@pytest.mark.parametrize(("moved", "is_far"), [(0.149, False), (0.151, True), (-0.149, False), (-0.151, True)])
def test_an_element_may_move_by_5_percent_while_it_is_enabled(moved, is_far):
    """Of a range of 3 rad."""
    begin, limits = start()
    begin.note(measured(0.3), 10.0)
    begin.check(10.0, limits)
    text = begin.moved(measured(0.3 + moved))
    assert bool(text) is is_far
    assert (f"joint_position.shoulder went from 0.3 to {0.3 + moved:.4g}" in text) is is_far
    assert begin.moved(measured(math.nan)) == ""
    free = Start(SafetyBench("velocity").config, "velocity")
    free.note(measured(0.3), 10.0)
    assert free.moved(measured(99.0)) == ""


def test_a_start_far_outside_is_refused():
    begin, limits = start()
    begin.note(measured(2.1), 10.0)
    with pytest.raises(CommandRefused, match="Far outside"):
        begin.check(10.0, limits)


@pytest.mark.parametrize(
    ("time_to_live", "period", "cycles"), [(0.1, 0.005, 80), (0.1, 0.01, 64), (1.0, 0.005, 800), (0.101, 0.005, 81)]
)
def test_cycles_that_a_command_may_answer(time_to_live, period, cycles):
    watchdog = CommandWatchdog(time_to_live, period)
    for cycle in range(1, 2001):
        watchdog.note(cycle, 10.0)
    assert watchdog.expiry(2001 - cycles, 10.0) == pytest.approx(10.0 + time_to_live)
    with pytest.raises(CommandRefused, match=f"{cycles} cycles ago"):
        watchdog.expiry(2000 - cycles, 10.0)


def test_the_age_of_a_command():
    watchdog = CommandWatchdog(0.1, 0.005)
    watchdog.note(1, 10.0)
    assert watchdog.expiry(1, 10.1 - 1e-9) == pytest.approx(10.1)
    with pytest.raises(CommandRefused, match="101 ms ago; a command lives 100 ms"):
        watchdog.expiry(1, 10.101)


@pytest.mark.parametrize(("gap", "is_problem"), [(0.005, False), (0.19, False), (0.21, True)])
def test_a_gap_between_two_cycles(gap, is_problem):
    watchdog = CycleWatchdog()
    assert watchdog.problem(10.0) == ""
    text = watchdog.problem(10.0 + gap)
    assert bool(text) is is_problem
    assert (f"did not turn for {gap:.2f} s, longest allowed is 0.2 s" in text) is is_problem
    assert watchdog.problem(10.0 + gap + 0.1) == ""


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([1.0], "has 2 values, not shape"),
        ([[1.0, 2.0]], "has 2 values"),
        ([1.0, math.inf], r"q\.b is inf"),
        ([math.nan, 1.0], r"q\.a is nan"),
    ],
)
def test_commands_that_are_no_numbers(values, text):
    with pytest.raises(CommandRefused, match=text):
        checked(values, "q", ("a", "b"))
    given = np.array([1.0, 2.0])
    copy = checked(given, "q", ("a", "b"))
    assert copy is not given
    assert copy.tolist() == [1.0, 2.0]


def test_a_request_waits_half_a_second_for_the_cycle():
    lock, held, release = CycleLock(), threading.Event(), threading.Event()

    def cycle():
        with lock.cycle():
            held.set()
            release.wait(5.0)

    thread = threading.Thread(target=cycle)
    thread.start()
    held.wait(5.0)
    with lock.within(0.01) as is_free:
        assert not is_free
    begun = time.monotonic()
    with pytest.raises(CommandRefused, match="stuck"), lock.request():
        raise AssertionError
    assert 0.49 < time.monotonic() - begun < 1.4
    release.set()
    thread.join()
    for _ in range(2):  # it was released each time
        with lock.within(0.01) as is_free:
            assert is_free
        with lock.request():
            pass


@pytest.mark.parametrize("quantity", ["position", "velocity"])
def test_a_limit_that_cannot_act_names_its_measurement(quantity):
    limits = limiter("effort")
    name = {"position": "range", "velocity": "velocity"}[quantity]
    text = f"The {name} limit cannot act without a valid {quantity} of shoulder."
    assert limits.blind(measured(**{quantity: math.nan})) == text
    assert limits.blind(measured()) == ""
