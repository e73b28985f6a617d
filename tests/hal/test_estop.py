"""The emergency stop: in every mode, twice at once, with a stuck cycle, a silent drive, a bus that is gone."""

import threading
import time

import numpy as np
import pytest
from hal_bench import Bench, description
from safety_bench import PARK, SafetyBench

from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.device import DeviceHealth, DeviceState
from hal.errors import CommandRefused
from hal.robot import open_robot

DONE = "stopped and without power after"


def estop(bench, times=1, turn=None):
    """What came of emergency stops that are asked for at once, while the robot cycles."""
    found = []
    threads = [threading.Thread(target=lambda: found.append(bench.robot.estop("a test"))) for _ in range(times)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        (turn or bench.cycle)()
        time.sleep(0.0005)
    return found


def into(bench, mode):
    """Bring a robot into a mode."""
    bench.cycle()
    if mode == "homing":
        bench.robot.home("shoulder_drive")
    elif mode == "enabling":
        bench.joints[0].enable = lambda: None
        bench.robot.enable()
    elif mode == "fault":
        bench.enable()
        bench.joints[0].state = DeviceState.FAULT
    elif mode != "off":
        bench.enable()
        if mode != "hold":
            bench.follow([1.0, 1.0], 20)
        if mode == "stopping":
            bench.robot.stop("a test")
    if mode != "off":
        bench.cycle(1)
    assert bench.robot.mode == mode


@pytest.mark.parametrize("mode", ["off", "enabling", "hold", "follow", "homing", "stopping", "fault"])
def test_works_in_every_mode_and_is_latched(mode):
    bench = SafetyBench()
    into(bench, mode)
    (found,) = estop(bench)
    assert found.is_complete
    assert [one.device for one in found.devices] == ["shoulder_drive", "elbow_drive"]
    assert all(one.text.startswith(DONE) for one in found.devices)
    assert found.text == ""
    bench.cycle(10)
    assert bench.robot.mode == "fault"
    assert bench.robot.fault_text.startswith("Emergency stop: a test")
    assert (bench.velocities == 0).all()
    with pytest.raises(CommandRefused, match="Reset it first"):
        bench.robot.enable()
    for joint in bench.joints:
        joint.state = DeviceState.READY
    bench.robot.reset()
    assert bench.robot.mode == "off"


def test_the_fault_before_it_is_told_too():
    bench = SafetyBench()
    into(bench, "fault")
    estop(bench)
    assert bench.robot.fault_text.startswith("Emergency stop: a test Before that: 'shoulder_drive' is fault")


def test_it_is_asked_in_several_cycles():
    bench = SafetyBench()
    into(bench, "follow")
    for joint in bench.joints:
        joint.asked.clear()
    estop(bench)
    bench.cycle(10)
    assert all(joint.asked.count("quick_stop") >= 5 for joint in bench.joints)
    assert all("apply" not in joint.asked for joint in bench.joints)


def test_parking_is_cut_short():
    bench = SafetyBench(stop=PARK)
    into(bench, "follow")
    bench.robot.stop("a test")
    bench.cycle(5)
    assert estop(bench)[0].is_complete
    where = bench.positions
    bench.cycle(100)
    np.testing.assert_array_equal(bench.positions, where)


def test_two_at_once_both_get_their_answer():
    bench = SafetyBench()
    into(bench, "follow")
    found = estop(bench, 2)
    assert [one.is_complete for one in found] == [True, True]


def test_a_drive_that_does_not_obey_is_told():
    bench = SafetyBench()
    into(bench, "follow")
    bench.joints[1].is_deaf = True
    (found,) = estop(bench)
    assert not found.is_complete
    assert found.devices[0].has_stopped
    assert found.devices[1].text == "is still enabled; cut the power"


def test_a_driver_that_raises_or_blocks_keeps_no_other_from_stopping():
    bench = SafetyBench()
    into(bench, "follow")
    never = threading.Event()
    bench.joints[0].quick_stop = never.wait
    (found,) = estop(bench, turn=lambda: bench.clock.advance(0.02) or bench.joints[1].move(0.02))
    never.set()
    assert [one.has_stopped for one in found.devices] == [False, True]


def test_a_stuck_cycle_is_said_loudly_and_every_drive_is_stopped_all_the_same():
    bench = SafetyBench(clock=SystemClock())
    bench.robot.cycle()
    bench.robot.enable()
    bench.robot.cycle()
    never, moved = threading.Event(), threading.Event()
    bench.joints[0].apply = lambda values: never.wait(30)

    def cycle():
        bench.robot.cycle()
        moved.set()

    threading.Thread(target=cycle).start()
    time.sleep(0.05)
    bench.joints[1].asked.clear()
    for joint in bench.joints:
        joint.quick_stop = lambda joint=joint: joint.asked.append("quick_stop") or setattr(joint, "state", "stopping")
        joint.health = lambda joint=joint: _rests(joint)
    found = bench.robot.estop("a test")
    assert found.is_complete
    assert "The HAL's cycle is stuck" in found.text
    with pytest.raises(CommandRefused, match="The HAL's cycle is stuck"):
        bench.robot.enable()
    never.set()
    assert moved.wait(5)
    assert "apply" not in bench.joints[1].asked
    bench.robot.cycle()
    assert bench.robot.mode == "fault"


def _rests(joint):
    """At rest once it was asked to stop four times."""
    count = joint.asked.count("quick_stop")
    return DeviceHealth(DeviceState.READY if count >= 4 else DeviceState.STOPPING if count else DeviceState.ENABLED)


class TestOnBuses:
    @pytest.fixture
    def bench(self):
        bench = Bench().open()
        yield bench
        bench.close()

    def test_moving_drives_are_at_rest_before_they_are_without_power(self, bench):
        bench.enable()
        bench.follow([0.4, 0.2], 40)
        (found,) = estop(bench)
        assert found.is_complete, found
        where = bench.world.length.copy()
        bench.cycle(50)
        np.testing.assert_array_equal(bench.world.length, where)
        assert not any(enabled for _, enabled in bench.world.drives.values())
        assert bench.robot.mode == "fault"
        bench.robot.reset()
        bench.enable()

    def test_a_silent_drive_is_told_and_the_other_stopped(self, bench):
        bench.enable()
        bench.rig.fault("node_silent triceps_drive")
        (found,) = estop(bench)
        assert [one.has_stopped for one in found.devices] == [True, False]
        assert found.devices[1].text == "did not answer (silent); cut the power"

    def test_a_stuck_cycle_does_not_keep_the_drives_from_being_asked_and_heard(self, bench):
        bench.enable()
        never = threading.Event()
        device = bench.robot._devices[0]
        apply, device.apply = device.apply, lambda values: never.wait(30)
        stuck = threading.Thread(target=bench.robot.cycle)
        stuck.start()
        time.sleep(0.02)
        (found,) = estop(bench, turn=bench.pass_time)
        assert found.is_complete, found
        assert "The HAL's cycle is stuck" in found.text
        never.set()
        stuck.join()
        device.apply = apply
        bench.cycle(3)
        assert bench.robot.mode == "fault"
        assert not any(enabled for _, enabled in bench.world.drives.values())


@pytest.mark.long
def test_drives_on_a_bus_that_is_gone_cannot_be_reached():
    robot = open_robot(RobotConfig.model_validate(description()))
    found = robot.estop("a test")
    assert [one.text for one in found.devices] == [
        "cannot be reached, bus 'can0' is gone; cut the power",
        "cannot be reached, bus 'can1' is gone; cut the power",
    ]
    assert robot.mode == "fault"
