import math

import pytest

from simulators.nodes.rotor import Rotor


def test_a_push_settles_at_the_speed_where_friction_takes_it_all():
    rotor = Rotor(inertia=0.1, friction=0.5)
    rotor.push(2.0, 100.0)
    assert rotor.velocity == pytest.approx(4.0)  # rad/s


@pytest.mark.parametrize("steps", [1, 7, 500])
def test_the_way_does_not_depend_on_the_steps(steps):
    rotor = Rotor(inertia=0.1, friction=0.5)
    for _ in range(steps):
        rotor.push(2.0, 0.3 / steps)
    rate = 5.0
    assert rotor.velocity == pytest.approx(4.0 * (1 - math.exp(-rate * 0.3)))
    assert rotor.position == pytest.approx(4.0 * 0.3 - 4.0 * (1 - math.exp(-rate * 0.3)) / rate)


def test_without_friction_it_is_accelerated():
    rotor = Rotor(inertia=2.0, friction=0.0, position=1.0)
    rotor.push(4.0, 0.5)
    assert (rotor.velocity, rotor.position) == (pytest.approx(1.0), pytest.approx(1.25))


def test_it_runs_and_rests():
    rotor = Rotor(inertia=1.0, friction=1.0)
    assert rotor.run(-0.5, 0.2) == pytest.approx(-0.1)
    rotor.rest(3.0)
    assert (rotor.position, rotor.velocity) == (3.0, 0.0)
