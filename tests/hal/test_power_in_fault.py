"""A drive that reports a fault may have power still, and must not be told to be without."""

import threading

import numpy as np
import pytest

from hal.errors import CommandRefused

OVERTEMPERATURE = 0x4210
GENERIC = 0x01


@pytest.fixture
def hot(bench):
    """Following; then a drive reports an emergency, and takes no control words any more."""
    bench.enable()
    bench.follow([0.3, 0.25], 3)
    node = bench.rig.node("biceps_drive")
    node.objects.after_write[0x6040] = lambda sub: None
    node.emergency(OVERTEMPERATURE, GENERIC)
    bench.cycle(3)
    assert bench.device("biceps_drive")["state"] == "fault"
    assert node.servo[1], "it has power"
    return bench


def test_it_is_not_reset(hot):
    with pytest.raises(CommandRefused, match="Still enabled: biceps_drive"):
        hot.robot.reset()


def test_the_emergency_stop_says_that_it_has_not_stopped(hot):
    found = []
    asking = threading.Thread(target=lambda: found.append(hot.robot.estop("test")))
    asking.start()
    while asking.is_alive():
        hot.cycle()
    (emergency,) = found
    assert not emergency.is_complete
    report = {one.device: one for one in emergency.devices}
    assert report["biceps_drive"].text == "is still under power, in fault; cut the power"
    assert report["triceps_drive"].has_stopped


def test_after_a_silence_the_robot_starts_from_where_it_was_moved_to(bench):
    bench.cycle(5)
    bench.rig.fault("node_silent biceps_drive")
    bench.cycle(60)
    bench.world.length[0] += 0.015  # m, by hand, less than what a slipping brake is forgiven
    bench.rig.fault("node_back biceps_drive")
    bench.until(lambda: np.isfinite(bench.sample.values["muscle_length"]).all(), "the drive is back")
    bench.until(lambda: bench.states() == {"ready"}, "commissioned", 400)
    bench.robot.enable()
    _, applied = bench.cycle()
    assert applied.values[0] == pytest.approx(0.315, abs=1e-4)  # m
