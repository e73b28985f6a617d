"""A drive that does not do as it is asked, whatever it says, is a fault with its name; a slow one is not."""

import numpy as np
import pytest
from safety_bench import LIMITS, PERIOD, SafetyBench

GO = {"position": [1.5, 1.0], "velocity": [0.8, 0.0], "effort": [1.8, 0.0]}


def stuck(joint):
    """It says that it is enabled, and stays where it is."""

    def move(duration):
        joint.velocity = joint.effort = 0.0

    joint.move = move


@pytest.mark.parametrize("quantity", GO)
def test_a_drive_that_says_it_is_enabled_and_does_not_move_is_a_fault(quantity):
    bench = SafetyBench(quantity).enable()
    stuck(bench.joints[0])
    while bench.sample.cycle < 300:
        bench.follow(GO[quantity]) if bench.robot.mode in ("hold", "follow") else bench.cycle()
        if bench.robot.mode == "fault":
            break
    assert "'shoulder_drive' does not follow: joint_" in bench.robot.fault_text
    assert bench.sample.cycle * PERIOD < 1.0
    assert "quick_stop" in bench.joints[1].asked, "the whole group stops"


@pytest.mark.parametrize("quantity", GO)
def test_a_drive_that_follows_is_none(quantity):
    bench = SafetyBench(quantity).enable()
    for count in range(400):
        sign = 1 if (count // 100) % 2 == 0 else -1
        bench.follow(sign * np.array(GO[quantity]) if quantity != "position" else np.array([0.3, 0.3 + sign]))
    assert bench.robot.mode == "follow", bench.robot.fault_text


def test_a_held_drive_that_is_pushed_away_is_a_fault():
    bench = SafetyBench("position", command={"signal": "joint_position", "hold": 10.0}).enable()
    bench.joints[1].move = lambda duration: setattr(bench.joints[1], "position", 0.6)
    bench.cycle(40)
    assert "'elbow_drive' does not follow: joint_position.elbow is 0.6" in bench.robot.fault_text


def test_a_drive_that_comes_nearer_may_take_its_time():
    limits = {"joint_position": {"low": -1, "high": 2}}  # a set-point may be anywhere at once
    bench = SafetyBench("position", limits=limits).enable()
    joint = bench.joints[0]
    joint.move = lambda duration: setattr(joint, "position", min(joint.position + 0.3 * duration, joint.target))
    bench.follow([1.8, 0.3], 1100)
    assert bench.robot.mode == "follow"
    assert joint.position == pytest.approx(1.8)


def test_single_wrong_frames_are_no_fault():
    bench = SafetyBench("position").enable()
    joint, move = bench.joints[0], bench.joints[0].move
    for count in range(300):
        joint.move = (lambda _: setattr(joint, "position", 1.0)) if count % 10 == 0 else move
        bench.follow([0.3, 0.3])
        joint.position = 0.3
    assert bench.robot.mode == "follow"


def test_the_tolerance_is_the_robot_files():
    command = {"signal": "joint_position", "following_error": [0.5, np.inf], "hold": 10.0}
    bench = SafetyBench("position", command=command).enable()
    for joint, place in zip(bench.joints, (0.7, 2.0), strict=True):
        joint.move = lambda duration, joint=joint, place=place: setattr(joint, "position", place)
    bench.cycle(100)
    assert bench.robot.mode == "hold"
    bench.joints[0].move = lambda duration: setattr(bench.joints[0], "position", 0.9)
    bench.cycle(100)
    assert "does not follow" in bench.robot.fault_text


def test_an_encoder_that_jumps_under_power_is_a_fault():
    bench = SafetyBench("position").enable()
    joint, move = bench.joints[0], bench.joints[0].move
    bench.follow([0.3, 0.3], 10)

    def jumped(duration):
        joint.position = 0.3
        move(duration)
        joint.position = 0.9

    joint.move = jumped
    for _ in range(60):
        bench.follow([0.3, 0.3]) if bench.robot.mode == "follow" else bench.cycle()
    assert "'shoulder_drive' does not follow: joint_position.shoulder is 0.9" in bench.robot.fault_text


def test_a_slow_brake_or_precharge_has_the_time_that_the_robot_file_gives():
    for timeout, mode in ((2.0, "fault"), (4.0, "hold")):
        command = {"signal": "joint_position", "enable_timeout": timeout, "hold": 10.0}
        bench = SafetyBench("position", limits=LIMITS["position"], command=command)
        joint = bench.joints[0]
        joint.is_deaf = True
        bench.cycle()
        bench.robot.enable()
        bench.cycle(round(3.0 / PERIOD))
        if bench.robot.mode == "enabling":
            joint.is_deaf = False
            joint.enable()
            bench.cycle(3)
        assert bench.robot.mode == mode
        if mode == "fault":
            assert "Not enabled within 2 s: shoulder_drive" in bench.robot.fault_text
            assert "command.enable_timeout" in bench.robot.fault_text
