"""The lie of every column that explains the network's errors, against least squares on whitened errors."""

import numpy as np
import pytest

from gemuco.trust.relations import Relations
from gemuco.trust.sensitivity import LINEAR, Sensed

ERRORS, COLUMNS, SAMPLES = 6, 5, 7


def least_squares(error: np.ndarray, slopes: np.ndarray, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lies that explain one sample's errors, shape (errors,), best, and their standard deviations."""
    root = np.linalg.cholesky(precision).T
    lies, *_ = np.linalg.lstsq(root @ slopes, root @ error, rcond=None)
    return lies, np.sqrt(np.diag(np.linalg.inv(slopes.T @ precision @ slopes)))


@pytest.fixture(scope="module")
def sensitivity(schema):
    return Relations.of(schema).sensitivity


DRAW = np.random.default_rng(2)
ROOT = DRAW.normal(size=(ERRORS, ERRORS))
PRECISION = ROOT @ ROOT.T + np.eye(ERRORS)
SLOPES = DRAW.normal(size=(SAMPLES, ERRORS, COLUMNS))
MISSES = 0.05 * DRAW.normal(size=(SAMPLES, ERRORS))


@pytest.mark.parametrize("hidden", [(), (2,), (0, 3), (1, 2, 4)])
def test_lies_are_those_of_least_squares_with_the_hidden_columns_free(sensitivity, hidden):
    value, spread = sensitivity.lies(Sensed.of(MISSES, SLOPES, PRECISION), frozenset(hidden))
    for number in range(SAMPLES):
        for column in range(COLUMNS):
            columns = sorted({*hidden, column})
            lies, std = least_squares(MISSES[number], SLOPES[number][:, columns], PRECISION)
            assert value[number, column] == pytest.approx(lies[columns.index(column)], rel=1e-5, abs=1e-7)
            assert spread[number, column] == pytest.approx(std[columns.index(column)], rel=1e-5)


def test_the_errors_say_nothing_of_a_column_that_looks_like_a_hidden_one(sensitivity):
    slopes = SLOPES.copy()
    slopes[:, :, 3] = -2.0 * slopes[:, :, 0]
    slopes[:, :, 4] = 0.0
    alike = Sensed.of(MISSES, slopes, PRECISION)
    value, spread = sensitivity.lies(alike, frozenset({0}))
    assert np.isinf(spread[:, [3, 4]]).all()
    assert not value[:, [3, 4]].any()
    assert np.isfinite(spread[:, [0, 1, 2]]).all()
    _, both = sensitivity.lies(alike, frozenset({0, 3}))
    assert both[:, [0, 3]].min() > 30.0  # the errors say how wrong their sum is, and next to nothing of each


def test_where_a_hidden_column_is_far_off_the_derivatives_are_not_used(sensitivity):
    errors = MISSES.copy()
    errors[2] += SLOPES[2] @ np.array([0.0, 2.0 * LINEAR, 0.0, 0.0, 0.0])
    _, spread = sensitivity.lies(Sensed.of(errors, SLOPES, PRECISION), frozenset({1}))
    assert np.isinf(spread[2]).all()
    assert np.isfinite(np.delete(spread, 2, axis=0)).all()
