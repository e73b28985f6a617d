"""Path lengths, moment arms and elastic elements against finite differences and pencil and paper."""

import math

import numpy as np
import pytest

from simulators.muscles import Elastic, Paths, Sphere, Via
from simulators.robots.musashi_arm.body import VARIANTS, make_body
from simulators.robots.musashi_arm.model import chain

CAPSULE = Sphere(4, (0.0, 0.0, 0.0), 0.02)


def elbow_wire(start: Via, end: Via, *spheres: Sphere) -> Paths:
    return Paths(chain(), {"wire": (start, end)}, spheres)


def at_elbow(angle: float) -> np.ndarray:
    return np.array([0.0, 0.0, 0.0, angle, 0.0])


@pytest.mark.parametrize("variant", VARIANTS)
def test_moment_arms_are_the_slope_of_the_lengths(variant):
    paths = make_body(variant, 3).paths
    random = np.random.default_rng(0)
    step = 1e-6
    for position in random.uniform(chain().low, chain().high, (30, 5)):
        arms = paths.solve(position)[1]
        for joint, away in enumerate(step * np.eye(5)):
            slope = (paths.lengths(position + away) - paths.lengths(position - away)) / (2 * step)
            assert arms[:, joint] == pytest.approx(slope, abs=1e-7)


def test_a_wire_parallel_to_the_arm_has_the_moment_arm_one_sees():
    wire = elbow_wire(Via(3, 0.03, 0.0, -0.10), Via(4, 0.03, 0.0, -0.15))
    lengths, arms = wire.solve(at_elbow(0.0))
    assert lengths == pytest.approx([0.30])
    assert arms[0] == pytest.approx([0.0, 0.0, 0.0, 0.03, 0.0])


def test_a_wire_within_one_link_never_changes():
    routes = {"still": (Via(3, 0.0, 0.0, 0.0), Via(3, 0.0, 0.3, 0.4)), "moving": (Via(0, 1, 0, 0), Via(5, 0, 0, 0))}
    wire = Paths(chain(), routes)
    lengths, arms = wire.solve(np.array([-0.5, 0.3, 0.2, -1.0, 0.4]))
    assert lengths[0] == pytest.approx(0.5)
    assert not arms[0].any()


def test_a_wire_that_clears_its_sphere_stays_straight():
    wire = elbow_wire(Via(3, 0.0, 0.0, -0.15), Via(4, 0.0, 0.0, -0.10), CAPSULE)
    assert wire.lengths(at_elbow(-2.0)) == pytest.approx([2 * 0.1 * math.cos(1.0)])


def test_a_bent_wire_goes_tangent_arc_tangent():
    ends = Via(3, -0.02, 0.0, -0.15), Via(4, -0.02, 0.0, -0.10)
    bent, straight = elbow_wire(*ends, CAPSULE), elbow_wire(*ends)
    lengths, arms = bent.solve(at_elbow(-0.3))
    assert lengths == pytest.approx([0.1 + 0.02 * 0.3 + 0.1])
    assert arms[0, 3] == pytest.approx(-0.02)
    assert straight.lengths(at_elbow(-0.3)) < lengths


def test_a_wire_touches_its_sphere_without_a_jump():
    wire = elbow_wire(Via(3, -0.025, 0.01, -0.15), Via(4, -0.03, 0.0, -0.10), CAPSULE)
    angles = np.linspace(-2.0, 0.1, 4001)
    lengths = np.array([wire.lengths(at_elbow(angle))[0] for angle in angles])
    slopes = np.diff(lengths) / np.diff(angles)
    assert np.abs(np.diff(slopes)).max() < 1e-3


def test_the_elastic_element_and_its_inverse():
    elastic = Elastic.of(3, 20.0, 120.0)
    tension = np.array([0.0, 50.0, 200.0])
    assert elastic.tension(elastic.elongation(tension)) == pytest.approx(tension, abs=1e-10)
    assert elastic.tension(np.array([-0.01, 0.0, -1.0])) == pytest.approx(np.zeros(3))
    step = 1e-7
    slope = (elastic.tension(elastic.elongation(tension) + step) - tension) / step
    assert elastic.stiffness(tension) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize(("variant", "least", "most"), [("geometric", 0.019, 0.021), ("actual", 0.015, 0.040)])
def test_200_newton_stretch_every_element_by_about_20_millimetres(variant, least, most):
    for seed in range(5):
        elongation = make_body(variant, seed).elastic.elongation(np.full(10, 200.0))
        assert elongation.min() > least
        assert elongation.max() < most
