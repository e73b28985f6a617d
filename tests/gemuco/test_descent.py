from itertools import pairwise

import numpy as np
import pytest

from gemuco.search.descent import DescentConfig, descend


def valley(points, slope=True):
    """Narrow in one direction; least at (1, -2)."""
    difference = points - np.array([1.0, -2.0])
    scale = np.array([1.0, 30.0])
    return (scale * difference**2).sum(axis=1), 2 * scale * difference


def test_never_rises_and_arrives():
    found = descend(valley, np.array([4.0, 4.0]), DescentConfig(gamma_max=0.5, candidates=30, iterations=60))
    assert all(after <= before for before, after in pairwise(found.losses))
    np.testing.assert_allclose(found.point, [1.0, -2.0], atol=0.02)


def test_one_candidate_is_a_constant_step():
    found = descend(valley, np.array([4.0, 4.0]), DescentConfig(gamma_max=0.01, candidates=1, iterations=1))
    np.testing.assert_allclose(found.point, [4.0 - 0.01 * 6.0, 4.0 - 0.01 * 360.0])


def test_a_constant_step_that_diverges_keeps_the_best_point():
    found = descend(valley, np.array([1.0, -1.0]), DescentConfig(gamma_max=1.0, candidates=1, iterations=10))
    assert found.loss == pytest.approx(30.0)


def test_begins_from_the_best_of_several_starts():
    found = descend(valley, np.array([[9.0, 9.0], [1.0, -2.0]]), DescentConfig(iterations=0))
    np.testing.assert_array_equal(found.point, [1.0, -2.0])


def test_stays_inside_its_bounds():
    found = descend(valley, np.zeros(2), DescentConfig(iterations=50), low=np.array([-1.0, -1.0]), high=np.ones(2))
    assert found.point[1] == -1.0
    assert found.point[0] == pytest.approx(1.0, abs=0.05)


def circle(points):
    """Distance from the unit circle, and its gradient."""
    radius = np.linalg.norm(points, axis=1)
    return (radius - 1.0)[:, None], (points / radius[:, None])[:, None, :]


def test_meets_a_constraint_and_moves_along_it():
    found = descend(valley, np.array([0.3, 2.0]), DescentConfig(gamma_max=0.1, iterations=60), constraint=circle)
    assert np.linalg.norm(found.point) == pytest.approx(1.0, abs=1e-6)
    turn = np.linspace(0.0, 2 * np.pi, 3601)
    least = valley(np.stack([np.cos(turn), np.sin(turn)], axis=1))[0].min()
    assert found.loss == pytest.approx(least, abs=0.01)


def test_an_impossible_constraint_ends_where_least_is_missing():
    low, high = np.array([-0.5, -0.5]), np.array([0.5, 0.5])
    found = descend(valley, np.array([0.3, 0.2]), DescentConfig(iterations=30), low, high, circle)
    assert np.linalg.norm(found.point) == pytest.approx(np.sqrt(0.5), abs=0.02)
