"""Set-points of joints and wires as commands of the motor in MIT mode, and answers in SI, by arithmetic done by hand.

DM4310: 12.5 rad, 30 rad/s, 10 N m. Behind a gear of 5 the motor turns five times as far as the joint, so stiffness and
damping of the joint are divided by 25 and its effort by 5.
"""

import math

import pytest

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.drivers.can_device import Place
from hal.drivers.mit.law import Law
from hal.drivers.mit.settings import MitSettings
from hal.errors import ConfigError
from hal.protocols.mit import Command
from hal.wire.bus import Bus

MIDDLE = (32767.5, 2047.5, 2047.5)
"""Counts at which the motor stands at 0 rad, at rest and without torque."""


def law(mode="position", bounds=None, **settings):
    bus = Bus("can0", BusConfig(interface="virtual", channel="mit_law"), SystemClock())
    ends = bounds or {"position": (-1.0, 1.0), "velocity": (-1.0, 1.0), "effort": (-5.0, 5.0)}[mode]
    place = Place("elbow", {mode: f"joint_{mode}.elbow"}, bus, 1, None, 200.0, bounds=ends)
    given = {"motor": "DM4310", "stiffness": 100.0, "damping": 5.0, "gear": 5.0, "ramp": 0.02, **settings}
    return Law(place, MitSettings.model_validate({"mode": mode, **given}))


def test_a_position_behind_a_gear_with_a_stiffness_that_grows():
    joint = law(zero=0.2)
    stiffnesses = []
    for _ in range(6):
        command = joint.set_point(0.6, MIDDLE)
        stiffnesses.append(command.stiffness)
    assert stiffnesses == pytest.approx([1.0, 2.0, 3.0, 4.0, 4.0, 4.0])  # 100 / 25, in 0.02 s of 5 ms
    assert command == Command(pytest.approx(2.0), 0.0, pytest.approx(4.0), pytest.approx(0.2), 0.0)
    joint.restart()
    assert joint.set_point(0.6, MIDDLE).stiffness == pytest.approx(1.0)


def test_a_direction_turns_the_angle_only():
    joint = law(zero=0.2, direction=-1, ramp=0.0)
    assert joint.set_point(0.6, MIDDLE) == Command(pytest.approx(-2.0), 0.0, pytest.approx(4.0), pytest.approx(0.2), 0)


def test_a_wire_on_a_spool():
    """10 mm: 4 rad of the motor are 8 mm of wire; 100 N/m are 100 * (0.01 / 5)^2 N m/rad."""
    wire = law(spool_radius=0.01, ramp=0.0, bounds=(-0.02, 0.02), stiffness=1e6, damping=1e5)
    expected = Command(pytest.approx(4.0), 0.0, pytest.approx(4.0), pytest.approx(0.4), 0.0)
    assert wire.set_point(0.008, MIDDLE) == expected


@pytest.mark.parametrize(
    ("value", "angle"),
    [
        (0.1, 0.5),
        (0.9, 1.0),  # 20 N m of the joint are 4 of the motor, and 4 N m/rad: no more than 1 rad ahead
        (-0.9, -1.0),
    ],
)
def test_the_stiffness_pulls_with_no_more_than_the_largest_effort(value, angle):
    assert law(max_effort=20.0, ramp=0.0).set_point(value, MIDDLE).position == pytest.approx(angle)
    assert law(ramp=0.0).set_point(value, MIDDLE).position == pytest.approx(5 * value)


def test_the_largest_effort_during_the_ramp():
    joint = law(max_effort=20.0)
    assert joint.set_point(0.9, MIDDLE).position == pytest.approx(4.0)  # a quarter of the stiffness
    assert joint.set_point(0.9, MIDDLE).position == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("value", "most", "speed"),
    [(0.5, None, 2.5), (0.5, 0.5, 0.5), (-0.5, 0.5, -0.5), (0.05, 0.5, 0.25)],
)
def test_a_velocity(value, most, speed):
    """The damping is 0.2 N m s/rad at the motor, and 0.5 N m of the joint are 0.1 of the motor."""
    command = law("velocity", max_effort=most).set_point(value, MIDDLE)
    assert command == Command(0.0, pytest.approx(speed), 0.0, pytest.approx(0.2), 0.0)


def test_a_velocity_is_limited_around_the_velocity_of_the_motor():
    joint = law("velocity", max_effort=0.5)
    moving = (32767.5, 2047.5 + 4095 / 60 * 2.0, 2047.5)  # 2 rad/s of 30
    assert joint.set_point(0.9, moving).velocity == pytest.approx(2.5)
    assert joint.set_point(-0.9, moving).velocity == pytest.approx(1.5)
    assert joint.set_point(0.9, None).velocity == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("value", "most", "direction", "torque"),
    [(3.0, None, 1, 0.6), (3.0, None, -1, -0.6), (5.0, 2.0, 1, 0.4), (-5.0, 2.0, 1, -0.4), (99.0, None, 1, 10.0)],
)
def test_an_effort(value, most, direction, torque):
    command = law("effort", max_effort=most, direction=direction).set_point(value, MIDDLE)
    assert command == Command(0.0, 0.0, 0.0, 0.0, pytest.approx(torque))


def test_rest_and_brake():
    joint = law()
    assert joint.resting((65535, 0, 0)) == Command(pytest.approx(12.5), 0.0, 0.0, 0.0, 0.0)
    assert joint.resting((0, 4095, 4095)) == Command(pytest.approx(-12.5), 0.0, 0.0, 0.0, 0.0)
    assert joint.resting(None) == Command(0.0, 0.0, 0.0, 0.0, 0.0)
    assert joint.braking() == Command(0.0, 0.0, 0.0, pytest.approx(0.2), 0.0)


@pytest.mark.parametrize(("direction", "sign"), [(1, 1.0), (-1, -1.0)])
def test_answers_in_si(direction, sign):
    lines = law(zero=0.2, direction=direction).lines
    for counts in (0, 1):
        found = [offset + slope * top * counts for (slope, offset), top in zip(lines, (65535, 4095, 4095), strict=True)]
        end = sign * (2 * counts - 1)
        assert found == pytest.approx([0.2 + end * 2.5, end * 6.0, end * 50.0])  # rad, rad/s, N m


@pytest.mark.parametrize(
    ("mode", "settings", "bounds", "ends"),
    [
        ("position", {"zero": 1.0}, (-1.6, 1.0), "-1.5 to 3.5"),
        ("position", {"zero": 1.0}, (0.0, 3.6), "-1.5 to 3.5"),
        ("position", {"direction": -1, "zero": 1.0}, (-1.6, 1.0), "-1.5 to 3.5"),
        ("velocity", {}, (-6.1, 6.0), "-6 to 6"),
        ("velocity", {}, (-6.0, 6.1), "-6 to 6"),
        ("effort", {}, (-51.0, 50.0), "-50 to 50"),
        ("effort", {"direction": -1}, (-50.0, 51.0), "-50 to 50"),
        ("position", {}, (1.0, 1.0), "-2.5 to 2.5"),
    ],
)
def test_limits_beyond_the_frames(mode, settings, bounds, ends):
    with pytest.raises(ConfigError, match=ends):
        law(mode, bounds, **settings)


@pytest.mark.parametrize(
    ("mode", "bounds"), [("position", (-2.5, 2.5)), ("velocity", (-6.0, 6.0)), ("effort", (-50.0, 50.0))]
)
def test_limits_that_just_fit(mode, bounds):
    law(mode, bounds)


def test_ranges_of_the_table_and_of_ones_own():
    own = {"position": 1.0, "velocity": 2.0, "effort": 3.0, "layout": "damiao"}
    base = {"motor": "DM4310", "stiffness": 1.0, "damping": 1.0}

    def ranges(**given):
        layout, found = MitSettings.model_validate({**base, "ranges": given}).actuator
        return layout.value, found.position, found.velocity, found.effort, found.stiffness, found.damping

    assert ranges() == ("damiao", 12.5, 30.0, 10.0, 500.0, 5.0)
    own_layout = {**base, "ranges": {"layout": "t_motor"}, "allow_no_watchdog": True}
    assert MitSettings.model_validate(own_layout).actuator[0].value == "t_motor"
    assert MitSettings.model_validate(own_layout).actuator[1].effort == 10.0
    assert ranges(**own) == ("damiao", 1.0, 2.0, 3.0, 500.0, 5.0)
    assert ranges(**own, stiffness=50.0, damping=2.0) == ("damiao", 1.0, 2.0, 3.0, 50.0, 2.0)
    for place, name in enumerate(("position", "velocity", "effort", "stiffness", "damping"), 1):
        expected = ["damiao", 12.5, 30.0, 10.0, 500.0, 5.0]
        expected[place] = 4.0
        assert ranges(**{name: 4.0}) == tuple(expected)


@pytest.mark.parametrize(
    ("settings", "scale"),
    [({}, 1.0), ({"gear": 4.0}, 0.25), ({"gear": 4.0, "direction": -1, "spool_radius": 0.02}, -0.005)],
)
def test_scale(settings, scale):
    base = {"motor": "DM4310", "stiffness": 1.0, "damping": 1.0}
    assert math.isclose(MitSettings.model_validate({**base, **settings}).scale, scale)
