"""Size of healthy errors at each sample: learned where it differs, and never from the value that is judged."""

import numpy as np
import pytest

from gemuco.normal.local import RANGE, SMALLER, Grid, LocalSize

COUNT = 500


def samples(seed: int, columns: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return values and errors; those of column 0 are five times as large where column 1 is low."""
    random = np.random.default_rng(seed)
    values = random.normal(size=(COUNT, columns))
    errors = random.normal(size=(COUNT, columns))
    errors[:, 0] *= np.where(values[:, 1] < -0.5, 5.0, 1.0)
    return values, errors / np.sqrt(np.mean(errors**2, axis=0))


@pytest.mark.parametrize("seed", range(5))
def test_errors_are_large_where_they_were(seed):
    values, ratios = samples(seed)
    size = LocalSize.fit(Grid.of(values), ratios, frozenset())
    assert (size.steps > 0).tolist() == [True, False, False, False]
    fresh, errors = samples(seed + 100)
    scale = size(fresh)
    assert (scale[:, 1:] == 1.0).all()
    low, high = fresh[:, 1] < -1.0, fresh[:, 1] > 0.5
    usual = np.sqrt(0.31 * 25.0 + 0.69)  # the share of the samples below -0.5 is 0.31
    assert np.median(scale[low, 0]) == pytest.approx(5.0 / usual, rel=0.3)
    smaller = np.median(scale[high, 0])
    assert smaller == pytest.approx(usual**-SMALLER, rel=0.3), "smaller errors are half believed"
    within = np.abs(errors[:, 0] / scale[:, 0]) < 2.0
    assert abs(within[low].mean() - within[high].mean()) < abs(
        (np.abs(errors[low, 0]) < 2.0).mean() - (np.abs(errors[high, 0]) < 2.0).mean()
    )


def test_no_lie_excuses_itself_and_no_hidden_value_does():
    values, ratios = samples(0)
    ratios[:, 1] = ratios[:, 0]  # the errors of column 1 depend on its own value only
    size = LocalSize.fit(Grid.of(values), ratios, frozenset())
    assert not size.steps[1]
    whole, hidden = (
        LocalSize.fit(Grid.of(values), ratios, frozenset()),
        LocalSize.fit(Grid.of(values), ratios, frozenset({1}), size),
    )
    wrong = values.copy()
    wrong[:, 1] += 10.0
    assert not np.array_equal(whole(wrong)[:, 0], whole(values)[:, 0])
    np.testing.assert_array_equal(hidden(wrong), hidden(values))
    gross = values.copy()
    gross[:, 0] += 100.0
    np.testing.assert_array_equal(whole(gross)[:, 0], whole(values)[:, 0])


def test_sizes_stay_within_their_range_also_far_outside_and_with_missing_values():
    values, ratios = samples(1)
    size = LocalSize.fit(Grid.of(values), ratios, frozenset())
    far = np.full((3, 4), 1e6)
    far[1] = np.nan
    far[2] = -1e6
    assert ((size(far) >= RANGE[0]) & (size(far) <= RANGE[1])).all()


def test_few_or_unknown_errors_leave_one_size():
    values, ratios = samples(2)
    assert not LocalSize.fit(Grid.of(values[:10]), ratios[:10], frozenset()).steps.any()
    ratios[:, 0] = np.nan
    assert not LocalSize.fit(Grid.of(values), ratios, frozenset()).steps.any()


def test_errors_from_few_stretches_of_time_may_be_larger_next_time():
    """Six stands of a car with one error each are no 60 errors."""
    random, values = np.random.default_rng(3), np.random.default_rng(4).normal(size=(COUNT, 2))
    stands = np.arange(COUNT) % 80 < 10
    values[:, 1] = np.where(stands, -2.0, 1.0) + 0.1 * random.normal(size=COUNT)
    sizes = {}
    for name, errors in {
        "independent": random.normal(size=COUNT),
        "alike": np.repeat(random.normal(size=COUNT // 10), 10),
    }.items():
        ratios = np.stack([np.where(stands, 10.0 * errors, random.normal(size=COUNT)), random.normal(size=COUNT)], 1)
        own = np.sqrt(np.mean(ratios[stands, 0] ** 2) / np.mean(ratios[:, 0] ** 2))
        sizes[name] = np.median(LocalSize.fit(Grid.of(values), ratios, frozenset())(values)[stands, 0]) / own
    assert sizes["independent"] == pytest.approx(1.0, abs=0.15)
    assert 1.3 < sizes["alike"] < 2.0
