"""`Robot` with one device that serves everything and no bus, as data collection uses it."""

import numpy as np
import pytest
from hal_bench import description

from hal.clock import ManualClock
from hal.config import RobotConfig
from hal.device import Device, DeviceHealth, DeviceState, Reading
from hal.errors import CommandRefused, ConfigError, DeviceSilent
from hal.robot import Robot

CONFIG = RobotConfig.model_validate(description(devices={}))


class Everything(Device):
    """All elements, in an order of its own; set-points are reached at once."""

    name = "everything"

    def __init__(self, clock, measures=None, commands=("muscle_length.triceps", "muscle_length.biceps")):
        self.measures = tuple(measures or reversed(CONFIG.element_names()))
        self.commands = commands
        self.values = dict(zip(CONFIG.element_names(), [0.5, 20.0, 30.0, 0.3, 0.25], strict=True))
        self.state = DeviceState.CLOSED
        self.idled = 0
        self._clock = clock

    def open(self):
        self.state = DeviceState.READY

    def read(self):
        values = np.array([self.values[name] for name in self.measures])
        return Reading(values, np.full(len(values), self._clock.monotonic()))

    def health(self):
        return DeviceHealth(self.state)

    def close(self):
        self.state = DeviceState.CLOSED

    def enable(self):
        self.state = DeviceState.ENABLED

    def disable(self):
        self.state = DeviceState.READY

    def apply(self, values):
        self.values.update(zip(self.commands, values.tolist(), strict=True))

    def idle(self):
        self.idled += 1


@pytest.fixture
def clock():
    return ManualClock()


@pytest.fixture
def device(clock):
    return Everything(clock)


@pytest.fixture
def robot(clock, device):
    with Robot(CONFIG, [device], clock=clock, source="simulated") as robot:
        yield robot


def turn(robot, clock, count=1):
    for _ in range(count):
        result = robot.cycle()
        clock.advance(robot.period)
    return result


def test_each_value_lands_in_its_element(robot, clock):
    sample, _ = turn(robot, clock)
    assert sample.complete
    assert sample.source == "simulated"
    assert {name: values.tolist() for name, values in sample.values.items()} == {
        "joint_position": [0.5],
        "muscle_tension": [20.0, 30.0],
        "muscle_length": [0.3, 0.25],
    }


def test_each_set_point_lands_in_its_drive(robot, clock, device):
    turn(robot, clock)
    robot.enable()
    sample, applied = turn(robot, clock, 2)
    assert applied.mode == "hold"
    np.testing.assert_array_equal(applied.values, [0.3, 0.25])
    robot.command(np.array([0.3005, 0.2505]), sample.cycle)
    _, applied = turn(robot, clock)
    assert applied.mode == "follow"
    assert device.values["muscle_length.biceps"] == pytest.approx(0.3005)
    assert device.values["muscle_length.triceps"] == pytest.approx(0.2505)


def test_samples_are_not_changed_by_later_cycles(robot, clock, device):
    sample, _ = turn(robot, clock)
    device.values["joint_position.elbow"] = 0.9
    turn(robot, clock)
    assert sample.values["joint_position"][0] == 0.5


def test_while_off_devices_are_idled(robot, clock, device):
    turn(robot, clock, 3)
    assert device.idled == 3


def test_a_value_that_is_not_finite_is_not_valid(robot, clock, device):
    device.values["muscle_tension.biceps"] = np.inf
    sample, _ = turn(robot, clock)
    assert sample.valid["muscle_tension"].tolist() == [False, True]
    assert np.isnan(sample.values["muscle_tension"][0])


def test_a_drive_far_outside_its_range_is_not_enabled(robot, clock, device):
    device.values["muscle_length.biceps"] = -0.2
    turn(robot, clock)
    with pytest.raises(Exception, match=r"Far outside limits.muscle_length: biceps -0.2"):
        robot.enable()
    assert robot.mode == "off"


def test_a_drive_that_drops_out_is_a_fault(robot, clock, device):
    turn(robot, clock)
    robot.enable()
    turn(robot, clock, 2)
    device.state = DeviceState.READY
    _, applied = turn(robot, clock)
    assert applied.mode == "fault"
    assert np.isnan(applied.values).all()
    robot.reset()
    assert robot.mode == "off"


def test_enabling_takes_no_longer_than_it_may(robot, clock, device):
    device.enable = lambda: None
    turn(robot, clock)
    robot.enable()
    turn(robot, clock, 399)
    assert robot.mode == "enabling"
    turn(robot, clock, 3)
    assert robot.mode == "fault"
    assert "Not enabled within 2 s: everything" in robot.fault_text


def test_a_drive_that_does_not_let_go_is_a_fault(robot, clock, device):
    turn(robot, clock)
    robot.enable()
    turn(robot, clock, 2)
    device.disable = lambda: None
    robot.disable()
    turn(robot, clock, 202)
    assert robot.mode == "fault"
    assert "Cut the power" in robot.fault_text


def test_what_opening_raises_is_passed_on(clock, device):
    def fails():
        raise DeviceSilent("nobody there")

    device.open = fails
    with pytest.raises(DeviceSilent):
        Robot(CONFIG, [device], clock=clock).open()


@pytest.mark.parametrize(
    ("measures", "commands", "report"),
    [
        (CONFIG.element_names()[1:], None, "fails for joint_position.elbow"),
        ([*CONFIG.element_names(), "joint_position.elbow"], None, "fails for joint_position.elbow"),
        ([*CONFIG.element_names(), "joint_position.knee"], None, "fails for joint_position.knee"),
        (None, ("muscle_length.biceps",), "fails for muscle_length.triceps"),
        (None, ("muscle_length.biceps",) * 2, "fails for muscle_length.triceps"),
    ],
)
def test_devices_must_fit_the_robot_file(clock, measures, commands, report):
    device = Everything(clock, measures, commands or ("muscle_length.biceps", "muscle_length.triceps"))
    with pytest.raises(ConfigError, match=report):
        Robot(CONFIG, [device], clock=clock)


def test_enabling_forgives_a_short_gap_and_not_a_long_one(robot, clock, device):
    turn(robot, clock)
    device.values["muscle_length.biceps"] = np.nan
    turn(robot, clock, 2)
    robot.enable()
    _, applied = turn(robot, clock)
    np.testing.assert_array_equal(applied.values, [0.3, 0.25])
    robot.disable()
    device.values["muscle_length.biceps"] = np.nan
    turn(robot, clock, 60)
    assert robot.mode == "off"
    with pytest.raises(CommandRefused, match="No valid muscle_length of biceps,"):
        robot.enable()
