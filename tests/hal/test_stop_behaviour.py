"""How a robot stops: what its file says, what a fault does, and what is refused meanwhile."""

import numpy as np
import pytest
from safety_bench import LIMITS, PARK, PERIOD, SafetyBench

from hal.clock import ManualClock
from hal.device import DeviceState
from hal.errors import CommandRefused


def moving(quantity="position", **stop):
    bench = SafetyBench(quantity, stop=stop).enable()
    bench.follow([1.0, 1.0], 40)
    assert (np.abs(bench.velocities) > 0.05).all()
    return bench


def test_hold_comes_to_rest_on_the_ramp_holds_and_lets_go():
    bench = moving(behaviour="hold")
    bench.robot.stop("a test")
    speeds = []
    while bench.robot.mode == "stopping":
        bench.cycle()
        speeds.append(bench.velocities.copy())
    speeds = np.array(speeds)
    assert (np.abs(np.diff(speeds, axis=0)) <= 10.0 * PERIOD + 1e-9).all()
    assert (speeds[-20:] == 0).all()
    assert len(speeds) * PERIOD == pytest.approx(0.5, abs=0.02)
    assert bench.robot.mode == "off"
    assert [joint.state for joint in bench.joints] == [DeviceState.READY] * 2


def test_a_velocity_robot_holds_by_standing_still():
    bench = moving("velocity", behaviour="hold")
    bench.robot.stop("a test")
    bench.cycle(45)
    assert bench.robot.mode == "stopping"
    assert (bench.velocities == 0).all()
    assert bench.until("off") * PERIOD == pytest.approx(0.5 - 45 * PERIOD, abs=0.02)


@pytest.mark.parametrize("quantity", ["velocity", "effort"])
def test_damp_resists_motion_and_lets_go(quantity):
    bench = moving(quantity, behaviour="damp")
    bench.robot.stop("a test")
    applied = bench.cycle(2)
    assert bench.robot.mode == "stopping"
    assert all(joint.asked[-1] == "damp" for joint in bench.joints)
    assert np.isnan(applied.values).all()
    bench.cycle(60)
    assert (np.abs(bench.velocities) < 0.1).all()
    assert bench.until("off") < 60


def test_park_moves_slowly_to_the_safe_posture_rests_and_lets_go():
    bench = moving(**PARK)
    bench.robot.stop("a test")
    before, speeds = bench.positions, []
    while bench.robot.mode == "stopping":
        bench.cycle()
        speeds.append(np.abs(bench.positions - before).max() / PERIOD)
        before = bench.positions
    np.testing.assert_allclose(bench.positions, [0.0, 1.0], atol=1e-9)
    assert bench.robot.mode == "off"
    assert max(speeds[-100:]) == 0 or speeds[-1] == 0
    assert max(speeds[30:]) <= 0.4 + 1e-9


def test_park_that_is_held_back_ends_in_a_fault_that_says_so():
    limits = {**LIMITS["position"], "joint_effort": {"soft_high": 5.0}}
    bench = SafetyBench("position", stop=PARK, limits=limits).enable()
    for joint in bench.joints:
        joint.move = lambda duration, joint=joint: vars(joint).update(effort=-6.0, position=joint.target)
    bench.robot.stop("a test")
    assert bench.until("fault", 6000) * PERIOD == pytest.approx(5 + 2 * 3 / 0.4, abs=0.1)
    assert "was not parked within 20 s" in bench.robot.fault_text


def test_off_lets_go_at_once():
    bench = moving(behaviour="off")
    bench.robot.stop("a test")
    assert all("disable" in joint.asked for joint in bench.joints)
    bench.cycle()
    assert bench.robot.mode == "off"


@pytest.mark.parametrize(
    ("quantity", "stop", "last"),
    [
        ("position", {"behaviour": "hold"}, "apply"),
        ("position", {"behaviour": "off"}, "apply"),
        ("position", PARK, "apply"),
        ("velocity", {"behaviour": "damp"}, "damp"),
        ("effort", {"behaviour": "damp"}, "damp"),
    ],
)
def test_a_commander_that_falls_silent_leads_to_hold_and_then_to_the_stop(quantity, stop, last):
    bench = moving(quantity, **stop)
    assert bench.until("hold") * PERIOD == pytest.approx(0.1, abs=0.02)
    bench.cycle(80)
    assert bench.robot.mode == "hold"
    assert (np.abs(bench.velocities) < 0.35).all()
    bench.until("off", 3000)
    asked = bench.joints[0].asked
    assert asked[len(asked) - asked[::-1].index("disable") - 2] == last


def test_no_command_is_taken_while_stopping_and_old_ones_are_forgotten():
    bench = moving(behaviour="hold")
    bench.robot.stop("a test")
    bench.cycle()
    with pytest.raises(CommandRefused, match="mode 'stopping'"):
        bench.robot.command(np.zeros(2), bench.sample.cycle)
    with pytest.raises(CommandRefused, match="still stopping"):
        bench.robot.enable()
    bench.until("off")
    where = bench.positions
    bench.robot.enable()
    bench.cycle(10)
    np.testing.assert_array_equal(bench.positions, where)
    np.testing.assert_array_equal(bench.applied.values, where)


def test_a_drive_that_drops_out_stops_the_group_as_fast_as_it_can():
    bench = moving()
    bench.joints[0].state, bench.joints[0].text = DeviceState.FAULT, "It is hot."
    bench.cycle()
    assert bench.robot.mode == "fault"
    assert "'shoulder_drive' is fault" in bench.robot.fault_text
    assert "It is hot." in bench.robot.fault_text
    bench.cycle(8)
    for joint in bench.joints:
        assert joint.asked[joint.asked.index("quick_stop") :].count("quick_stop") >= 5
        assert "apply" not in joint.asked[joint.asked.index("quick_stop") :]


def test_a_driver_that_raises_stops_all_others_too():
    bench = moving()
    bench.joints[0].apply = lambda values: 1 / 0
    bench.clock.advance(PERIOD)
    with pytest.raises(ZeroDivisionError):
        bench.robot.cycle()
    assert bench.robot.mode == "fault"
    assert bench.robot.fault_text == "The cycle failed: ZeroDivisionError: division by zero"
    assert all(joint.asked[-1] == "quick_stop" for joint in bench.joints)
    bench.cycle(30)
    assert (bench.velocities == 0).all()


def test_a_driver_that_raises_when_stopped_keeps_no_other_from_being_stopped():
    bench = moving()
    bench.joints[0].quick_stop = lambda: 1 / 0
    bench.joints[1].state = DeviceState.FAULT
    bench.clock.advance(PERIOD)
    with pytest.raises(ZeroDivisionError):
        bench.robot.cycle()
    assert "quick_stop" in bench.joints[1].asked


@pytest.mark.parametrize(("gap", "mode"), [(0.15, "hold"), (0.3, "fault"), (3.0, "fault")])
@pytest.mark.parametrize("quantity", ["position", "velocity", "effort"])
def test_a_cycle_that_was_frozen_sends_no_old_set_point(quantity, gap, mode):
    bench = moving(quantity, behaviour="damp")
    bench.robot.command(np.array([2.0, 2.0]), bench.sample.cycle)
    before, where = bench.applied.values, bench.positions
    for joint in bench.joints:
        joint.asked.clear()
    bench.clock.advance(gap)
    bench.sample, bench.applied = bench.robot.cycle()
    assert bench.robot.mode == mode
    assert np.isnan(bench.applied.desired).all()
    if mode == "fault":
        assert f"did not turn for {gap:.2f} s" in bench.robot.fault_text
        assert all("apply" not in joint.asked and "quick_stop" in joint.asked for joint in bench.joints)
    elif quantity == "effort":
        assert bench.joints[0].asked[-1] == "damp"
    else:
        step = {"position": 1.0 * PERIOD, "velocity": 5.0 * PERIOD}[quantity]
        assert (np.abs(bench.applied.values - before) <= step + 1e-9).all()
    np.testing.assert_array_equal(bench.positions, where)


def test_while_off_the_cycle_may_rest():
    bench = SafetyBench()
    bench.cycle()
    bench.clock.advance(10.0)
    bench.cycle()
    bench.enable()


class SteppingClock(ManualClock):
    """Its wall clock is set now and then."""

    step_ns = 0

    def now_ns(self):
        return super().now_ns() + self.step_ns


@pytest.mark.parametrize("hours", [-24, 24])
def test_a_step_of_the_wall_clock_changes_nothing(hours):
    bench = SafetyBench(clock=SteppingClock())
    bench.enable()
    bench.follow([1.0, 1.0], 20)
    bench.clock.step_ns = round(hours * 3600e9)
    bench.follow([1.0, 1.0], 20)
    assert bench.robot.mode == "follow"
    assert all(valid.all() for valid in bench.sample.valid.values())
    np.testing.assert_allclose(bench.velocities, 1.0)


def test_a_drive_that_is_enabled_without_being_asked_is_a_fault():
    bench = SafetyBench()
    bench.cycle(3)
    bench.joints[1].state = DeviceState.ENABLED
    bench.cycle()
    assert bench.robot.mode == "fault"
    assert "'elbow_drive' is enabled without a request" in bench.robot.fault_text


def test_a_fault_is_not_reset_while_a_drive_keeps_its_power():
    bench = moving()
    bench.joints[0].is_deaf = True
    bench.joints[1].state = DeviceState.FAULT
    bench.cycle(5)
    with pytest.raises(CommandRefused, match="Still enabled: shoulder_drive"):
        bench.robot.reset()
    assert bench.robot.mode == "fault"


def test_closing_stops_as_fast_as_the_drives_can():
    bench = moving()
    bench.robot.close()
    assert all("quick_stop" in joint.asked for joint in bench.joints)
    assert all(joint.state is DeviceState.CLOSED for joint in bench.joints)


class TestHoming:
    def test_only_from_off_and_ends_in_off(self):
        bench = SafetyBench()
        bench.cycle()
        bench.robot.home("shoulder_drive")
        assert bench.cycle(50).mode == "homing"
        assert "apply" not in bench.joints[0].asked
        with pytest.raises(CommandRefused, match="mode 'homing'"):
            bench.robot.enable()
        bench.joints[0].state = DeviceState.READY
        bench.cycle()
        assert bench.robot.mode == "off"

    def test_is_refused_while_enabled_and_of_what_cannot(self):
        bench = SafetyBench().enable()
        with pytest.raises(CommandRefused, match="mode 'hold'"):
            bench.robot.home("shoulder_drive")
        bench.robot.disable()
        bench.until("off")
        with pytest.raises(CommandRefused, match="no homing of its own"):
            bench.robot.home("elbow_drive")
        with pytest.raises(CommandRefused, match="no device 'knee'"):
            bench.robot.home("knee")
        assert bench.robot.mode == "off"

    @pytest.mark.parametrize("verb", ["stop", "disable", "estop"])
    def test_is_ended_by(self, verb):
        bench = SafetyBench()
        bench.cycle()
        bench.robot.home("shoulder_drive")
        bench.cycle(5)
        if verb == "estop":
            bench.joints[0].quick_stop = lambda: setattr(bench.joints[0], "state", DeviceState.READY)
        getattr(bench.robot, verb)(*([] if verb == "disable" else ["a test"]))
        assert bench.until("fault" if verb == "estop" else "off") < 30

    def test_by_a_fault_too_and_by_time(self):
        bench = SafetyBench()
        bench.cycle()
        bench.robot.home("shoulder_drive")
        bench.cycle(5)
        bench.joints[0].state, bench.joints[0].text = DeviceState.READY, "It found no switch."
        bench.cycle()
        assert "without having found its zero. It found no switch." in bench.robot.fault_text
        bench.joints[0].text = ""
        bench.robot.reset()
        bench.robot.home("shoulder_drive")
        assert bench.until("fault", 13000) * PERIOD == pytest.approx(60.0, abs=0.1)
