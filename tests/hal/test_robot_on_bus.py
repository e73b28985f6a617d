"""The three drivers against the simulated nodes: what is measured, commanded and refused."""

import time

import numpy as np
import pytest
from hal_bench import REAL_TIME_LIMIT, Bench

from hal.errors import CommandRefused


def test_measures_in_si_units(bench):
    sample, applied = bench.cycle(3)
    assert sample.complete
    assert sample.source == "simulated"
    np.testing.assert_allclose(sample.values["muscle_length"], bench.world.length, atol=1e-6)
    np.testing.assert_allclose(sample.values["muscle_tension"], bench.world.tension, atol=0.01)
    np.testing.assert_allclose(sample.values["joint_position"], bench.world.angle, atol=3e-5)
    assert all(valid.all() for valid in sample.valid.values())
    assert all((age < 0.005).all() for age in sample.age.values())
    assert applied.mode == "off"
    assert np.isnan(applied.values).all()


def test_numbers_cycles_and_says_when_they_were(bench):
    first, _ = bench.cycle()
    second, applied = bench.cycle()
    assert second.cycle == first.cycle + 1 == applied.cycle
    assert second.stamp_ns - first.stamp_ns == 5_000_000
    assert applied.stamp_ns == second.stamp_ns


def test_enables_without_moving(bench):
    before = bench.world.length.copy()
    bench.enable()
    bench.cycle(20)
    np.testing.assert_allclose(bench.world.length, before, atol=1e-6)
    np.testing.assert_allclose(bench.applied.values, before, atol=1e-6)
    assert all(enabled for _, enabled in bench.world.drives.values())


def test_follows_a_command_at_the_limited_rate(bench):
    bench.enable()
    start = bench.applied.values.copy()
    goal = start + np.array([0.01, -0.01])
    bench.follow(goal)
    assert bench.robot.mode == "follow"
    assert bench.applied.limited_by == ["rate"]
    np.testing.assert_allclose(bench.applied.values - start, [0.25 * 0.005, -0.25 * 0.005], rtol=1e-6)
    bench.follow(goal, 12)
    assert bench.applied.limited_by == []
    np.testing.assert_allclose(bench.world.length, goal, atol=1e-6)
    np.testing.assert_allclose(bench.applied.desired, goal)


def test_a_command_out_of_range_is_applied_inside(bench):
    bench.enable()
    bench.follow([0.05, 0.25], 200)
    assert "range" in bench.applied.limited_by
    assert bench.applied.values[0] == pytest.approx(0.1)
    assert bench.world.length.min() >= 0.1 - 1e-6


def test_a_command_that_stops_coming_leads_to_hold_and_then_to_off(bench):
    bench.enable()
    bench.follow([0.4, 0.25], 10)
    cycles = 0
    while bench.robot.mode == "follow":
        bench.cycle()
        cycles += 1
    assert bench.robot.mode == "hold"
    assert cycles * 0.005 == pytest.approx(0.1, abs=0.011)
    held = bench.applied.values
    assert np.isnan(bench.applied.desired).all()
    bench.cycle(95)
    assert bench.robot.mode == "hold"
    np.testing.assert_array_equal(bench.applied.values, held)
    bench.cycle(10)
    assert bench.robot.mode == "off"
    assert not any(enabled for _, enabled in bench.world.drives.values())


def test_stop_holds_and_then_disables(bench):
    bench.enable()
    bench.follow([0.4, 0.25], 10)
    bench.robot.stop("asked by a test")
    held = bench.cycle()[1].values
    with pytest.raises(CommandRefused, match="stopping"):
        bench.robot.command(np.array([0.2, 0.2]), bench.sample.cycle)
    bench.cycle(90)
    assert bench.robot.mode == "stopping"
    np.testing.assert_array_equal(bench.applied.values, held)
    bench.cycle(20)
    assert bench.robot.mode == "off"
    assert bench.robot.health()["stop_reason"] == "asked by a test"


def test_disable_lets_go_at_once(bench):
    bench.enable()
    bench.robot.disable()
    bench.cycle(4)
    assert bench.robot.mode == "off"
    assert not any(enabled for _, enabled in bench.world.drives.values())


def test_a_command_given_while_off_is_refused(bench):
    bench.cycle()
    with pytest.raises(CommandRefused, match="mode 'off'"):
        bench.robot.command(np.array([0.3, 0.3]), bench.sample.cycle)


@pytest.mark.parametrize(
    ("values", "back", "report"),
    [
        ([0.3], 0, "2 values"),
        ([[0.3, 0.3]], 0, "2 values"),
        ([0.3, np.nan], 0, "triceps is nan"),
        ([np.inf, 0.3], 0, "biceps is inf"),
        ([0.3, 0.3], -1, "has not been"),
        ([0.3, 0.3], 25, "125 ms"),
    ],
)
def test_bad_commands_are_refused_and_move_nothing(bench, values, back, report):
    bench.enable()
    bench.cycle(30)
    before = bench.world.length.copy()
    with pytest.raises(CommandRefused, match=report):
        bench.robot.command(np.array(values), bench.sample.cycle - back)
    bench.cycle(10)
    assert bench.robot.mode == "hold"
    np.testing.assert_array_equal(bench.world.length, before)


def test_a_tense_muscle_is_paid_out_and_a_slack_one_is_not(bench):
    bench.enable()
    before = bench.applied.values.copy()
    bench.world.tension[:] = [300.0, 30.0]
    bench.cycle(20)
    assert bench.applied.limited_by == ["tension"]
    paid = bench.applied.values - before
    assert paid[0] == pytest.approx(0.5 * 0.25 * 19 * 0.005, rel=0.1)
    assert paid[1] == 0.0
    bench.world.tension[:] = [100.0, 30.0]
    bench.cycle(2)
    held = bench.applied.values
    bench.cycle(5)
    np.testing.assert_array_equal(bench.applied.values, held)


def test_a_tense_muscle_is_not_shortened_by_a_command(bench):
    bench.enable()
    bench.world.tension[0] = 201.0
    bench.cycle(2)
    before = bench.applied.values.copy()
    bench.follow([0.1, 0.1], 20)
    assert bench.applied.values[0] >= before[0]
    assert bench.applied.values[1] < before[1]
    assert bench.applied.limited_by == ["rate", "tension"]


def test_too_much_tension_trips(bench):
    bench.enable()
    bench.world.tension[1] = 420.0
    bench.cycle(3)
    assert bench.robot.mode == "fault"
    assert "muscle_tension.triceps is 420" in bench.robot.fault_text
    bench.cycle(3)
    assert not any(enabled for _, enabled in bench.world.drives.values())
    with pytest.raises(CommandRefused, match="Reset it first"):
        bench.robot.enable()
    bench.world.tension[1] = 30.0
    bench.cycle(2)
    bench.robot.reset()
    bench.enable()


def test_a_fault_is_latched(bench):
    bench.enable()
    bench.world.tension[1] = 420.0
    bench.cycle(3)
    bench.world.tension[1] = 30.0
    bench.cycle(300)
    assert bench.robot.mode == "fault"


def test_enabling_before_the_first_cycle_is_refused():
    bench = Bench().open()
    deadline = time.monotonic() + REAL_TIME_LIMIT
    while bench.states() != {"ready"}:  # without a cycle, also if a node needs a second try
        assert time.monotonic() < deadline, bench.robot.health()
        bench.pass_time()
        bench.flush()
    with pytest.raises(CommandRefused, match="No valid muscle_length of biceps, triceps"):
        bench.robot.enable()
    bench.close()


def test_reset_is_refused_while_enabled(bench):
    bench.enable()
    with pytest.raises(CommandRefused, match="'hold'"):
        bench.robot.reset()


def test_closing_disables_and_leaves_no_drive_in_fault(bench):
    bench.enable()
    bench.while_time_passes(bench.robot.close)
    for _ in range(100):
        bench.pass_time()
    assert not any(enabled for _, enabled in bench.world.drives.values())
    assert bench.rig.node("biceps_drive").state.name == "SWITCH_ON_DISABLED"
    assert bench.device("biceps_drive")["state"] == "closed"
