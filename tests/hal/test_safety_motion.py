"""The limits together, in a robot that moves: whatever is commanded, the motion stays inside."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_bench import PERIOD, SafetyBench, description

from hal.config import RobotConfig
from hal.errors import CommandRefused, ConfigError
from hal.robot import Robot

ROUNDING = 1e-9
wishes = st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=12)


@settings(max_examples=25, deadline=None)
@given(wishes, st.integers(1, 40))
def test_position_commands_keep_range_velocity_and_acceleration(wanted, each):
    bench = SafetyBench("position").enable()
    before, speed = bench.positions, np.zeros(2)
    for wish in wanted:
        for _ in range(each):
            bench.follow(wish)
            now = (bench.positions - before) / PERIOD
            assert ((bench.positions >= -1 - ROUNDING) & (bench.positions <= 2 + ROUNDING)).all()
            assert (np.abs(now) <= 1.0 + 1e-9).all()
            assert (np.abs(now - speed) <= 10.0 * PERIOD + 1e-9).all()
            before, speed = bench.positions, now
    bench.cycle(60)
    assert bench.robot.mode == "hold"
    assert (bench.velocities == 0).all()
    assert ((bench.positions >= -1 - ROUNDING) & (bench.positions <= 2 + ROUNDING)).all()


@settings(max_examples=25, deadline=None)
@given(wishes, st.integers(10, 90))
@pytest.mark.long
def test_velocity_commands_keep_velocity_acceleration_and_the_range_of_the_position(wanted, each):
    bench = SafetyBench("velocity").enable()
    before = bench.velocities
    for wish in wanted:
        for _ in range(each):
            bench.follow(wish)
            assert ((bench.positions >= -1 - ROUNDING) & (bench.positions <= 2 + ROUNDING)).all()
            assert (np.abs(bench.velocities) <= 1.0).all()
            assert (np.abs(bench.velocities - before) <= 5.0 * PERIOD + 1e-9).all()
            before = bench.velocities
    assert bench.robot.mode == "follow"


@settings(max_examples=25, deadline=None)
@given(wishes, st.integers(10, 90))
def test_effort_commands_never_push_beyond_an_end_and_stop_before_it_is_far(wanted, each):
    bench = SafetyBench("effort").enable()
    for wish in wanted:
        for _ in range(each):
            if bench.robot.mode not in ("hold", "follow"):
                break
            bench.follow(wish)
            for joint in bench.joints:
                if joint.target is not None and bench.robot.mode == "follow":
                    assert abs(joint.target) <= 2.0
                    assert not (joint.position > 2.02 and joint.target > 0)
                    assert not (joint.position < -1.02 and joint.target < 0)
    bench.cycle(200)
    assert ((bench.positions > -1.5) & (bench.positions < 2.5)).all()
    assert (np.abs(bench.velocities) < 1.0).all()


def test_a_velocity_command_ends_close_to_the_end_of_the_range():
    bench = SafetyBench("velocity").enable()
    bench.follow([1.0, -1.0], 800)
    np.testing.assert_allclose(bench.positions, [2.0, -1.0], atol=0.01)
    assert "range" in bench.applied.limited_by
    bench.follow([-1.0, 1.0], 100)
    assert (bench.positions < 1.9).all()
    assert (bench.positions > -0.9).all()


@pytest.mark.parametrize("quantity", ["velocity", "effort"])
def test_the_start_is_without_velocity_or_effort_and_so_is_holding(quantity):
    bench = SafetyBench(quantity, stop={"behaviour": "off"}).enable()
    np.testing.assert_array_equal(bench.applied.values, [0.0, 0.0])
    bench.follow([0.5, 0.5], 50)
    np.testing.assert_allclose(bench.applied.values, 0.5)
    bench.until("hold")
    bench.cycle(30)
    np.testing.assert_array_equal(bench.applied.values, [0.0, 0.0])


def test_without_its_position_a_velocity_robot_comes_to_rest():
    bench = SafetyBench("velocity").enable()
    bench.follow([0.5, 0.5], 30)
    bench.joints[0].position = np.nan
    bench.follow([0.5, 0.5], 2)
    assert bench.applied.values[0] == 0.0
    assert bench.applied.values[1] == 0.5
    assert bench.robot.health()["limits"] == "The range limit cannot act without a valid position of shoulder."


def test_a_loaded_joint_is_moved_towards_relief_in_either_direction():
    limits = {"joint_position": {"rate": 1.0}, "joint_effort": {"soft_high": 5.0, "trip_high": 10.0, "trip_low": -10.0}}
    bench = SafetyBench("position", limits=limits).enable()
    for joint, effort in zip(bench.joints, (7.5, -7.5), strict=True):
        joint.move = lambda duration, joint=joint, effort=effort: setattr(joint, "effort", effort)
    bench.follow([1.0, -1.0], 10)
    assert bench.applied.values[0] < 0.3
    assert bench.applied.values[1] > 0.3
    assert bench.applied.limited_by == ["effort", "rate"]


@pytest.mark.parametrize(
    ("attribute", "value", "report"),
    [
        ("temperature", 91.0, "joint_temperature.shoulder is 91, over its trip limit of 90"),
        ("effort", -12.0, "joint_effort.shoulder is -12, under its trip limit of -10"),
        ("position", 2.2, "joint_position.shoulder is 2.2, beyond its range of -1 to 2. What moves it"),
    ],
)
def test_any_signal_may_trip_the_robot_within_one_cycle_of_its_measurement(attribute, value, report):
    limits = {
        "joint_position": {"low": -1, "high": 2, "rate": 1.0},
        "joint_temperature": {"trip_high": 90},
        "joint_effort": {"trip_low": -10, "trip_high": 10},
    }
    bench = SafetyBench("position", limits=limits).enable()
    bench.joints[0].move = lambda duration: setattr(bench.joints[0], attribute, value)
    bench.cycle()
    assert bench.robot.mode == "hold"
    bench.cycle()
    assert bench.robot.mode == "fault"
    assert report in bench.robot.fault_text
    assert all("quick_stop" in joint.asked for joint in bench.joints)


def test_a_robot_outside_of_its_limits_is_not_enabled_and_told_where():
    bench = SafetyBench("velocity")
    bench.joints[1].position = 2.4
    bench.cycle()
    with pytest.raises(CommandRefused, match=r"Far outside limits.joint_position: elbow 2.4 \(allowed: -1 to 2\)"):
        bench.robot.enable()
    assert bench.robot.mode == "off"
    assert "enable" not in bench.joints[0].asked


def test_a_robot_that_would_trip_is_not_enabled():
    bench = SafetyBench("position", limits={"joint_temperature": {"trip_high": 90}})
    bench.joints[0].temperature = 95.0
    bench.cycle()
    with pytest.raises(CommandRefused, match=r"joint_temperature\.shoulder is 95, over its trip limit"):
        bench.robot.enable()


@pytest.mark.parametrize(
    ("quantity", "stop", "report"),
    [
        ("effort", {"behaviour": "hold"}, "with effort commands use damp or off"),
        ("effort", {"behaviour": "park", "park": [0, 0], "speed": 1}, "with effort commands use damp or off"),
        ("velocity", {"behaviour": "park", "park": [0, 0], "speed": 1}, "with velocity commands use damp or off"),
        ("position", {"behaviour": "damp"}, "shoulder_drive, elbow_drive cannot damp"),
    ],
)
def test_a_stop_that_the_drives_cannot_do_is_refused_at_start(quantity, stop, report, monkeypatch):
    monkeypatch.setattr("safety_bench.Joint.can_damp", False)
    with pytest.raises(ConfigError, match=report):
        SafetyBench(quantity, stop=stop)


def test_drives_of_different_quantities_are_refused():
    bench = SafetyBench("position")
    bench.joints[0].command_quantity = "velocity"
    with pytest.raises(ConfigError, match="must be commanded in the same quantity"):
        Robot(RobotConfig.model_validate(description("position")), bench.joints, clock=bench.clock)


def test_a_range_of_nobody_knows_what_is_refused():
    bench = SafetyBench("velocity")
    for joint in bench.joints:
        joint.served = {}
    with pytest.raises(ConfigError, match="no device names the quantity of shoulder, elbow"):
        Robot(bench.config, bench.joints, clock=bench.clock)
