"""Size of healthy errors at each sample: learned where it differs, and never from the value that is judged."""

import numpy as np
import pytest

from gemuco.normal.local import RANGE, LocalSize

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
    size = LocalSize.fit(values, ratios, frozenset())
    assert size.uneven.tolist() == [True, False, False, False]
    fresh, errors = samples(seed + 100)
    scale = size(fresh)
    assert (scale[:, 1:] == 1.0).all()
    low, high = fresh[:, 1] < -1.0, fresh[:, 1] > 0.5
    assert np.median(scale[low, 0]) > 1.1  # 1.7 is the truth, in a step, which a square of the value describes poorly
    assert np.median(scale[low, 0]) > 1.5 * np.median(scale[high, 0])
    within = np.abs(errors[:, 0] / scale[:, 0]) < 2.0
    assert abs(within[low].mean() - within[high].mean()) < abs(
        (np.abs(errors[low, 0]) < 2.0).mean() - (np.abs(errors[high, 0]) < 2.0).mean()
    )


def test_no_lie_excuses_itself_and_no_hidden_value_does():
    values, ratios = samples(0)
    ratios[:, 1] = ratios[:, 0]  # the errors of column 1 depend on its own value only
    size = LocalSize.fit(values, ratios, frozenset())
    assert not size.uneven[1]
    whole, hidden = (
        LocalSize.fit(values, ratios, frozenset()),
        LocalSize.fit(values, ratios, frozenset({1}), size.uneven),
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
    size = LocalSize.fit(values, ratios, frozenset())
    far = np.full((3, 4), 1e6)
    far[1] = np.nan
    far[2] = -1e6
    assert ((size(far) >= RANGE[0]) & (size(far) <= RANGE[1])).all()


def test_few_or_unknown_errors_leave_one_size():
    values, ratios = samples(2)
    assert not LocalSize.fit(values[:10], ratios[:10], frozenset()).uneven.any()
    ratios[:, 0] = np.nan
    assert not LocalSize.fit(values, ratios, frozenset()).uneven.any()
