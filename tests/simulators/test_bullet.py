"""Rigid bodies in PyBullet: what must be conserved is."""

import numpy as np
import pytest

from simulators.bullet import BulletBody
from simulators.robots.musashi_arm.body import JOINT_DAMPING
from simulators.robots.musashi_arm.model import URDF, chain, gravity_torque

START = np.array([-0.4, -0.5, 0.1, -0.9, 0.0])


@pytest.fixture
def arm():
    arm = BulletBody(URDF, chain().joints, START)
    yield arm
    arm.close()


def test_a_free_swing_keeps_its_energy(arm):
    start = arm.energy()
    energies = []
    for _ in range(150):
        arm.step(np.zeros(5), 0.00125)
        energies.append(arm.energy())
    assert np.abs(arm.velocity).max() > 1.0
    assert energies == pytest.approx([start] * len(energies), abs=0.02)


def test_a_damped_swing_loses_it(arm):
    energies = []
    for _ in range(2000):
        arm.step(-JOINT_DAMPING * arm.velocity, 0.00125)
        energies.append(arm.energy())
    assert np.diff(energies).max() < 1e-4
    assert energies[-1] < energies[0] - 0.5


def test_gravity_torque_holds_it(arm):
    for _ in range(400):
        arm.step(gravity_torque(arm.position) - JOINT_DAMPING * arm.velocity, 0.00125)
    assert arm.position == pytest.approx(START, abs=1e-4)


def test_a_mass_in_the_hand_weighs(arm):
    arm.add_mass("elbow_yaw", 0.7, 0.05)
    arm.step(gravity_torque(START), 0.00125)
    assert arm.velocity[3] > 0.0


def test_stops_stop(arm):
    for _ in range(4000):
        arm.step(np.array([0.0, 0.0, 0.0, -2.0, 0.5]) - JOINT_DAMPING * arm.velocity, 0.00125)
        assert np.all(arm.position > chain().low - 0.05)
        assert np.all(arm.position < chain().high + 0.05)
    assert arm.position[4] == pytest.approx(chain().high[4], abs=0.01)
