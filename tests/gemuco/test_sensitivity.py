"""The lie of every column that explains the network's errors, against least squares on whitened errors."""

import numpy as np
import pytest

from gemuco.trust.relations import Relations
from gemuco.trust.sensitivity import FREE, LINEAR, Sensed

ERRORS, COLUMNS, SAMPLES = 6, 5, 7


def least_squares(sensed: Sensed, precision: np.ndarray, number: int, columns: list[int]) -> tuple[np.ndarray, ...]:
    """Return the lies of some columns that explain one sample's errors best, and their standard deviations."""
    root = np.linalg.cholesky(precision).T
    slopes = root @ sensed.slopes[number][:, columns]
    lies, *_ = np.linalg.lstsq(slopes, root @ sensed.errors[number], rcond=None)
    return lies, np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))


@pytest.fixture(scope="module")
def sensitivity(schema):
    return Relations.of(schema).sensitivity


@pytest.fixture
def precision() -> np.ndarray:
    root = np.random.default_rng(1).normal(size=(ERRORS, ERRORS))
    return root @ root.T + np.eye(ERRORS)


def sensed(precision: np.ndarray, seed: int = 2) -> Sensed:
    draw = np.random.default_rng(seed)
    slopes = draw.normal(size=(SAMPLES, ERRORS, COLUMNS))
    return Sensed.of(0.05 * draw.normal(size=(SAMPLES, ERRORS)), slopes, precision)


@pytest.mark.parametrize("hidden", [(), (2,), (0, 3), (1, 2, 4)])
def test_lies_are_those_of_least_squares_with_the_hidden_columns_free(sensitivity, precision, hidden):
    one = sensed(precision)
    value, spread = sensitivity.lies(one, frozenset(hidden))
    for number in range(SAMPLES):
        for column in range(COLUMNS):
            columns = sorted({*hidden, column})
            lies, std = least_squares(one, precision, number, columns)
            assert value[number, column] == pytest.approx(lies[columns.index(column)], rel=1e-5, abs=1e-7)
            assert spread[number, column] == pytest.approx(std[columns.index(column)], rel=1e-5)


def test_the_errors_say_nothing_of_a_column_that_looks_like_a_hidden_one(sensitivity, precision):
    one = sensed(precision)
    slopes = one.slopes.copy()
    slopes[:, :, 3] = -2.0 * slopes[:, :, 0]
    slopes[:, :, 4] = 0.0
    alike = Sensed.of(one.errors, slopes, precision)
    value, spread = sensitivity.lies(alike, frozenset({0}))
    assert np.isinf(spread[:, [3, 4]]).all()
    assert not value[:, [3, 4]].any()
    assert np.isfinite(spread[:, [0, 1, 2]]).all()
    _, both = sensitivity.lies(alike, frozenset({0, 3}))
    assert (both[:, [0, 3]] > 1e-2 / np.sqrt(FREE)).all() or np.isinf(both[:, [0, 3]]).all()


def test_where_a_hidden_column_is_far_off_the_derivatives_are_not_used(sensitivity, precision):
    one = sensed(precision)
    errors = one.errors.copy()
    errors[2] += one.slopes[2] @ np.array([0.0, 2.0 * LINEAR, 0.0, 0.0, 0.0])
    _, spread = sensitivity.lies(Sensed.of(errors, one.slopes, precision), frozenset({1}))
    assert np.isinf(spread[2]).all()
    assert np.isfinite(np.delete(spread, 2, axis=0)).all()
